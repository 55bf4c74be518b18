"""Pure numerics: no clock, no thread, no log, no I/O."""
