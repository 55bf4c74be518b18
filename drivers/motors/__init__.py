"""Motor controllers on serial ports, and a simulated one.

Begin with `serial_motor.py`: the driver of a port for any protocol. It locks the port, sends a stop first after every
pause or error, and opens a port again that was gone. `protocols/` turns commands into bytes and back without any I/O;
`simulated_motor.py` has a base with two wheels for `omnid simulate`. This package is loaded by the process that
steers: it imports no numpy and no OpenCV.
"""
