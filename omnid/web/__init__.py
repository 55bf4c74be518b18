"""`omnid web`: a page about a robot, served by a process of its own that subscribes to the bus."""
