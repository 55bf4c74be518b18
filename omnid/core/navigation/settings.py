"""Settings of the navigation: speeds, tolerances, waits, and the size of the base."""

from __future__ import annotations

from dataclasses import dataclass, field

from omnid.settings import knob


@dataclass(frozen=True, slots=True)
class PursuitSettings:
    """Regulated pure pursuit (Macenski et al. 2023); the limits of the controller hold after it."""

    velocity_mps: float = knob(0.4, "highest speed on a path, m/s", low=0.02, high=5)
    acceleration_mps2: float = knob(
        0.3,
        "acceleration and deceleration that are planned, m/s^2; below that of controller.heading",
        low=0.02,
        high=10,
    )
    yaw_rate_radps: float = knob(0.8, "highest yaw rate on a path, rad/s", low=0.02, high=10)
    lookahead_s: float = knob(1.2, "distance of the point that is driven to, as time at the speed, s", low=0.1, high=10)
    lookahead_m: tuple[float, float] = knob(
        (0.35, 0.9), "least and largest distance of that point, m", low=0.05, high=10
    )
    slow_radius_m: float = knob(
        0.7, "curves of a smaller radius are driven more slowly, in proportion, m", low=0.05, high=10
    )
    slow_obstacle_m: float = knob(
        0.6, "nearer than that to an obstacle, beside the base, it drives more slowly, m", low=0, high=5
    )
    least_mps: float = knob(0.05, "least speed where curves or obstacles slow it down, m/s", low=0.005, high=1)
    delay_s: float = knob(0.1, "from the exposure of the images to the motion that they lead to, s", low=0, high=1)


@dataclass(frozen=True, slots=True)
class NavigationSettings:
    """Goals, paths and routes."""

    pursuit: PursuitSettings = field(default_factory=PursuitSettings)
    goal_cm: float = knob(2.0, "a goal is reached within that distance, cm", low=0.1, high=200)
    goal_deg: float = knob(0.6, "and within that heading error, deg", low=0.1, high=180)
    clearance_m: float = knob(
        0.1,
        "distance to obstacles beside the path that is kept, beyond what the collision "
        "monitor demands (controller.collision), m",
        low=0,
        high=5,
    )
    corridor_m: float = knob(
        0.8, "how far beside the path it may go around obstacles, m; 0: it stays on it and waits", low=0, high=20
    )
    give_way_s: float = knob(
        4.0,
        "wait for a free way before it drives back along its own way, so that others can "
        "pass; then it comes again, and waits twice as long, s",
        low=0.5,
        high=3600,
    )
    give_way_m: float = knob(3.0, "how far it drives back at most, m; 0: it stays where it is blocked", low=0, high=20)
    stuck_s: float = knob(15.0, "wait for progress, with the way free, before it fails, s", low=1, high=3600)
    unlocalised_m: float = knob(
        3.0, "way in the map that it drives by odometry alone before it stops, m", low=0, high=1000
    )
    unlocalised_s: float = knob(60.0, "wait for the pose in the map before it fails, s", low=1, high=86_400)
    map_sigma_m: float = knob(0.3, "largest sigma of the pose in the map, m", low=0.01, high=10)
    reach_m: float = knob(100.0, "goals and paths that begin farther away are refused, m", low=1, high=100_000)
    routes: str = knob("routes", "folder of the routes; it is made if it is missing")
