"""What every host knows of the worlds that ship, without their simulators: a file of facts for each world."""
