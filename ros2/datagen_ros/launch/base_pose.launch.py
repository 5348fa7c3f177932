"""The node with its parameters; arguments name the camera's topics."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TOPICS = {
    "color": ("/camera/color/image_raw", "Picture, aligned to the depth image."),
    "depth": ("/camera/aligned_depth_to_color/image_raw", "Depth image: 16UC1 (mm) or 32FC1 (m)."),
    "camera_info": ("/camera/aligned_depth_to_color/camera_info", "CameraInfo of the depth image."),
    "map": ("/map", "OccupancyGrid of the floor."),
}


def generate_launch_description() -> LaunchDescription:
    """One node, base_pose."""
    default = PathJoinSubstitution([FindPackageShare("datagen_ros"), "config", "base_pose.yaml"])
    arguments = [
        DeclareLaunchArgument(name, default_value=topic, description=words)
        for name, (topic, words) in TOPICS.items()
    ]
    arguments.append(DeclareLaunchArgument("params_file", default_value=default, description="Parameters."))
    node = Node(
        package="datagen_ros",
        executable="base_pose_node",
        name="base_pose",
        output="screen",
        parameters=[LaunchConfiguration("params_file")],
        remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
    )
    return LaunchDescription([*arguments, node])
