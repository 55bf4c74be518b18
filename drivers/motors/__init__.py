"""Motor controllers behind a serial port."""
