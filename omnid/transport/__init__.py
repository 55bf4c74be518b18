"""Messages to the outside: CDR bytes and the zenoh bus."""
