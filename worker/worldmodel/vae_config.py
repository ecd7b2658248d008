"""The configuration of a VAE, in a module of its own that needs no torch. Pages: presets.md."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.schema.validation import added_option
from dreamfleet.worker.worldmodel.config_fields import MOST, check_factors, check_sizes, loss_factor

LEAK = 0.2  # slope of the leaky activation below zero
KERNEL, STRIDE = 4, 2
SIDES = (64, 96)  # of a picture, the usual one first; the help of `collect`, `iterate` and `pipeline` names them
PAPER_SIDES = (1, 5, 13, 30, 64)  # of the paper's decoder; its kernels 5, 5, 6, 6 follow


class ConvolutionLayer(NamedTuple):
    """A convolution, or a transposed one; odd padding or cropping goes to the end, as in TensorFlow."""

    inputs: int
    outputs: int
    kernel: int
    stride: int
    before: int  # rows and columns padded or cropped at the beginning
    after: int  # and at the end: equal or one more


@dataclass(frozen=True)
class VAEConfig:
    """The layers and the loss; the defaults are the paper's."""

    picture: int = option(64, "height and width of a picture: 64 or 96")
    latent: int = option(32, "latents of a picture")
    channels: tuple[int, ...] = option(
        (32, 64, 128, 256), "outputs of each of the encoder's convolutions; the decoder has as many"
    )
    padding: Literal["valid", "same"] = option(
        "valid", "padding of the convolutions: none, or zeros beyond a picture's edges"
    )
    activation: Literal["relu", "leaky_relu"] = option("relu", "after each convolution but the last")
    batch_norm: bool = option(default=False, text="normalise each convolution's outputs over the batch")
    dropout: float = option(0.0, "dropout of each convolution's outputs in training")
    loss: Literal["paper", "notebook"] = option(
        "paper", "squared error and a divergence with a tolerance, or 1000 times the mean square and the divergence"
    )
    kl_tolerance: float = option(0.5, "of the paper's loss: nats per latent below which the divergence costs nothing")
    dense: int = option(0, "inputs of a decoder that begins at 1x1; 0: as many as the encoder's outputs")
    error_factor: float = loss_factor(
        "weight of the reconstruction error against the divergence; above 1 latents keep more"
    )
    pixel_weight: float = added_option(
        0.0, "how much more the error counts of pixels that deviate from the mean picture, so that small things stay"
    )
    kernels: tuple[int, ...] = added_option((), "kernel of each of the encoder's convolutions, else 4")
    strides: tuple[int, ...] = added_option((), "stride of each, else 2; the decoder's are the same in reverse")
    decoder_channels: tuple[int, ...] = added_option(
        (), "outputs of the decoder's transposed convolutions but the last, else the encoder's in reverse"
    )
    decoder_kernels: tuple[int, ...] = added_option(
        (), "kernel of each of the decoder's transposed convolutions, else such that the picture's size results"
    )

    activate_dense: bool = added_option(default=False, text="the activation after the decoder's dense layer too")
    columns: int = added_option(
        0, "latents of each column of the last convolution, which see little beside it, so that they keep places; "
        "0: each latent sees the whole picture"
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_sizes(self)
        if self.picture not in SIDES:
            raise UsageError(f"a VAE's pictures are 64 or 96 pixels wide, not {self.picture}")
        if min(self.channels, default=0) < 1 or self.latent < 1:
            raise UsageError(f"a VAE has layers of channels and a latent, not {self.channels}, {self.latent}")
        if not 0 <= self.dropout < 1 or self.kl_tolerance < 0 or self.dense < 0:
            raise UsageError("dropout must be from 0 to below 1; a tolerance and a width must not be negative")
        check_factors(self, "error_factor")
        if not 0 <= self.pixel_weight <= MOST:
            raise UsageError(f"pixel_weight must be from 0 to {MOST:g}, not {self.pixel_weight:g}")
        count = len(self.channels)
        wanted = {"kernels": count, "strides": count, "decoder_channels": count - 1, "decoder_kernels": count}
        for name, length in wanted.items():
            given = getattr(self, name)
            if given and (len(given) != length or min(given) < 1):
                raise UsageError(f"{name} takes {plural(length, 'number')} above 0, as channels are {count}")
        if min(self.sides) < 1:
            raise UsageError(f"the encoder's convolutions leave nothing of {self.picture} pixels: choose fewer")
        if min(self.decoder_sides) < 1 or any(layer.before < 0 for layer in self.up):
            raise UsageError(
                f"the decoder's kernels {self._up_kernels} do not lead to {self.picture} pixels: choose others"
            )

        if self.columns < 0:
            raise UsageError(f"columns must be from 0, not {self.columns}")
        if self.columns and self.decoder_sides[0] != self.sides[-1]:
            raise UsageError("columns need a decoder that begins where the encoder ends: set padding to same")
        if self.columns and self.columns * self.sides[-1] != self.latent:
            each = plural(self.columns, "latent")
            raise UsageError(
                f"with {each} in each of {self.sides[-1]} columns, latent is {self.columns * self.sides[-1]}, "
                f"not {self.latent}"
            )

    @property
    def sides(self) -> tuple[int, ...]:
        """Height (= width) of the picture, then after each convolution."""
        sides = [self.picture]
        for kernel, stride in zip(self._down_kernels, self._strides, strict=True):
            inside = (sides[-1] - kernel) // stride + 1
            sides.append(-(-sides[-1] // stride) if self.padding == "same" else inside)
        return tuple(sides)

    @property
    def flat(self) -> int:
        """The number of outputs of the last convolution."""
        return self.channels[-1] * self.sides[-1] ** 2

    @property
    def down(self) -> tuple[ConvolutionLayer, ...]:
        """The encoder's convolutions."""
        same = self.padding == "same"
        channels = pairwise((3, *self.channels))
        sizes = zip(pairwise(self.sides), self._down_kernels, self._strides, strict=True)
        return tuple(
            _layer(*between, kernel, stride, max(0, (small - 1) * stride + kernel - large) if same else 0)
            for between, ((large, small), kernel, stride) in zip(channels, sizes, strict=True)
        )

    @property
    def up(self) -> tuple[ConvolutionLayer, ...]:
        """The decoder's transposed convolutions."""
        sizes = zip(pairwise(self.decoder_sides), self._up_kernels, self._strides[::-1], strict=True)
        return tuple(
            _layer(*between, kernel, stride, (small - 1) * stride + kernel - large)
            for between, ((small, large), kernel, stride) in zip(pairwise(self._up_channels), sizes, strict=True)
        )

    @property
    def decoder_sides(self) -> tuple[int, ...]:
        """Height (= width) before the first and after each transposed convolution.

        The paper's, or computed from `decoder_kernels`, else the encoder's in reverse. 0 marks impossible sizes.
        """
        if self.padding == "valid" and self.decoder_kernels:
            sides = [self.picture]
            for kernel, stride in zip(self.decoder_kernels[::-1], self._strides, strict=True):
                steps, rest = divmod(sides[0] - kernel, stride)
                sides.insert(0, steps + 1 if rest == 0 and sides[0] else 0)
            return tuple(sides)
        paper = (self.picture, self.padding, self.kernels, self.strides, len(self.channels)) == (64, "valid", (), (), 4)
        return PAPER_SIDES if paper else self.sides[::-1]

    @property
    def modules_a_layer(self) -> int:
        """The number of modules per layer: convolution, activation, and configured normalisation and dropout."""
        return 2 + self.batch_norm + (self.dropout > 0)

    @property
    def _down_kernels(self) -> tuple[int, ...]:
        return self.kernels or (KERNEL,) * len(self.channels)

    @property
    def _strides(self) -> tuple[int, ...]:
        return self.strides or (STRIDE,) * len(self.channels)

    @property
    def _up_channels(self) -> tuple[int, ...]:
        """Channels before and after each transposed convolution."""
        first = (self.dense or self.flat) if self.decoder_sides[0] == 1 else self.channels[-1]
        return (first, *(self.decoder_channels or self.channels[-2::-1]), 3)

    @property
    def _up_kernels(self) -> tuple[int, ...]:
        """The configured kernels, else the encoder's in reverse with `same` padding, else those without cropping."""
        if self.decoder_kernels or self.padding == "same":
            return self.decoder_kernels or self._down_kernels[::-1]
        sizes = zip(pairwise(self.decoder_sides), self._strides[::-1], strict=True)
        return tuple(large - stride * (small - 1) for (small, large), stride in sizes)


def _layer(inputs: int, outputs: int, kernel: int, stride: int, beyond: int) -> ConvolutionLayer:
    """Make a layer with `beyond` rows and columns of padding or cropping in total."""
    return ConvolutionLayer(inputs, outputs, kernel, stride, beyond // 2, beyond - beyond // 2)


PAPER = VAEConfig()
# DCtheTall/generative-deep-learning, 8-play/WorldModel.ipynb
NOTEBOOK = VAEConfig(
    picture=96, channels=(32, 64, 64, 128), padding="same", loss="notebook", decoder_kernels=(5, 5, 6, 6)
)
# AppliedDataSciencePartners/WorldModels, vae/arch.py; its loss is 10,000 times the mean square
ARTICLE = VAEConfig(channels=(32, 64, 64, 128), dense=1024, loss="notebook", error_factor=10.0)
