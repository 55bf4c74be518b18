"""Goals, paths and routes: path following, the way around obstacles, the state machine, teach and repeat."""
