"""Give poses and images to robots: ROS 2 messages in a bag. examples/ros2_node.py publishes live."""
