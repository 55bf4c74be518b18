"""Settings of the navigation: speeds, tolerances, waits, and the size of the base."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta


@dataclass(frozen=True, slots=True)
class PursuitSettings:
    """Regulated pure pursuit (Macenski et al. 2023); the limits of the controller hold after it."""

    velocity_mps: Annotated[float, Meta(ge=0.02, le=5), "highest speed on a path, m/s"] = 0.4
    acceleration_mps2: float = 0.3  # acceleration and deceleration that are planned, below that of controller.limits
    yaw_rate_radps: Annotated[float, Meta(ge=0.02, le=10), "highest yaw rate on a path, rad/s"] = 0.8
    lookahead_s: float = 1.2  # distance of the point that is driven to, as time at the speed, s
    lookahead_m: tuple[float, float] = (0.35, 0.9)  # least and largest distance of that point, m
    slow_radius_m: float = 0.7  # curves of a smaller radius are driven more slowly, in proportion, m
    slow_obstacle_m: float = 0.6  # distance of an obstacle beside the base, below which it drives more slowly, m
    least_mps: float = 0.05  # least speed where curves or obstacles slow it down, m/s
    delay_s: float = 0.1  # from the exposure of the images to the motion that they lead to, s


@dataclass(frozen=True, slots=True)
class NavigationSettings:
    """Goals, paths and routes."""

    pursuit: PursuitSettings = field(default_factory=PursuitSettings)
    goal_cm: Annotated[float, Meta(ge=0.1, le=200), "a goal is reached within that distance, cm"] = 2.0
    goal_deg: Annotated[float, Meta(ge=0.1, le=180), "and within that heading error, deg"] = 0.6
    clearance_m: Annotated[
        float,
        Meta(ge=0, le=5),
        "distance to obstacles beside the path that is kept, beyond what the collision "
        "monitor demands (controller.collision), m",
    ] = 0.1
    corridor_m: float = 0.8  # largest distance from the path around obstacles, m; 0: the base stays on it and waits
    stuck_s: float = 15.0  # time without progress on a free way before a drive fails, s
    give_up_s: Annotated[
        float, Meta(ge=0, le=86400), "a goal that no way leads to fails after so long, s; 0: it waits for ever"
    ] = 20.0
    unlocalised_m: float = 3.0  # way that is driven in the map by odometry alone, m
    unlocalised_s: float = 60.0  # wait for the pose in the map before a drive fails
    map_sigma_m: float = 0.3  # largest sigma of the pose in the map, m
    reach_m: float = 100.0  # goals and paths that begin farther away are refused, m
    routes: Annotated[str, "folder of the routes; it is made if it is missing"] = "routes"
