"""Start nav2 beside omnid: planner, controller, recoveries and the navigator, with velocities for omnid."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SERVERS = {
    "planner_server": "nav2_planner",
    "controller_server": "nav2_controller",
    "behavior_server": "nav2_behaviors",
    "bt_navigator": "nav2_bt_navigator",
}
VELOCITY = [("cmd_vel", "/omnid/cmd/planner/twist")]


def generate_launch_description():
    """Return the servers, and the manager that activates them."""
    parameters = LaunchConfiguration("params_file")
    own_time = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}
    servers = [
        Node(
            package=package,
            executable=name,
            name=name,
            parameters=[parameters, own_time],
            remappings=VELOCITY,
            output="screen",
        )
        for name, package in SERVERS.items()
    ]
    manager = Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name="lifecycle_manager_navigation",
        output="screen",
        parameters=[{"autostart": True, "node_names": list(SERVERS)}, own_time],
    )
    file = DeclareLaunchArgument("params_file", default_value="nav2_params.yaml")
    time = DeclareLaunchArgument("use_sim_time", default_value="false", description="time of omnid simulate, by /clock")
    return LaunchDescription([file, time, *servers, manager])
