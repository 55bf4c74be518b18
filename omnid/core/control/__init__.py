"""Control laws and safety rules of the base; no numpy, no I/O, no clock."""
