"""The log that `omnid demo` replays: two_walls at 512x512 without its last turn, its rig attached, and the truth."""
