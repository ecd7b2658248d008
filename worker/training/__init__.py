"""From nothing to a bundle: collect, train the VAE, encode, train the MDN-RNN, bundle."""
