"""Stages of the flow, one class each: state and glue around the numerics of `omnid.core`."""
