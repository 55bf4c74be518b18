"""A simulated robot in a simulated world, in lock-step with the stages or in real time."""
