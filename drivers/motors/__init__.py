"""Motor controllers on serial ports, real and simulated.

Begin with `serial_motor.py`: the driver of a port for any protocol. It locks the port, sends a stop first after every
pause or error, opens a port again that was gone, and names what it heard where no answer came. `protocols/` turns
commands into bytes and back without any I/O; `simulated/` has a base with two wheels and the firmware of the line
protocol, which `omnid simulate` and the tests drive by the same bytes. This package is loaded by the process that
steers: it imports no numpy and no OpenCV.
"""
