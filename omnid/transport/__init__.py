"""Messages to and from other programs: CDR bytes, the zenoh bus, names of topics and status entries."""
