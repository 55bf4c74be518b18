"""The boxes of the flow, one class each: short, state and glue around the numerics of `omnid.core`."""
