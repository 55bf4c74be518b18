"""`omnid listen`: a robot followed over the bus; its messages are counted, written to files and shown."""
