"""Give poses, map and images to robots: ROS 2 messages in a bag, or over a WebSocket while a run goes on."""
