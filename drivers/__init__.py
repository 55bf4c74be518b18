"""Hardware and logs: cameras, motors and recordings; drivers block and own no threads."""
