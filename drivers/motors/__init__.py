"""Motor controllers on serial ports, real and simulated."""
