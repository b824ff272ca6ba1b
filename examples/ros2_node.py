"""A ROS 2 node: SLAM on registered colour and depth images. It publishes each pose with its covariance.

python examples/ros2_node.py --ros-args -r color:=/camera/color/image_raw -r camera_info:=/camera/color/camera_info \\
    -r depth:=/camera/aligned_depth_to_color/image_raw

The images must be rectified. In the frame `map`, x is forward and z is up if the first image is level. Ctrl-C makes the
final map and writes map.ply. Tested with a simulated rclpy and the message types of ROS 2 Humble, not with a robot.
"""

from pathlib import Path

import numpy as np
import rclpy
from message_filters import ApproximateTimeSynchronizer, Subscriber
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image

from sigmasplat import RealTime, SigmaSplatError, Slam
from sigmasplat.run.session import interrupt_event
from sigmasplat.run_folder.splat_ply import write_field

R_MAP_WORLD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
LAYOUTS = {"rgb8": ("u1", 3), "bgr8": ("u1", 3), "16UC1": ("u2", 1), "mono16": ("u2", 1), "32FC1": ("f4", 1)}


def pixels(message: Image) -> np.ndarray:
    """Return the pixels [H, W, 3] or [H, W] of a message, without the padding of its rows."""
    kind, channels = LAYOUTS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    values = rows[:, : message.width * channels * dtype.itemsize].copy().view(dtype)
    return values if channels == 1 else values.reshape(message.height, message.width, channels)


class SlamNode(Node):
    """Tracks pairs of images as they arrive; the map is made on another thread."""

    def __init__(self) -> None:
        super().__init__("sigmasplat")
        self.slam, self.K = RealTime(Slam(self.declare_parameter("preset", "sigma").value)), None
        self.publisher = self.create_publisher(Odometry, "odometry", 10)
        self.create_subscription(CameraInfo, "camera_info", self.set_camera, qos_profile_sensor_data)
        topics = [Subscriber(self, Image, name, qos_profile=qos_profile_sensor_data) for name in ("color", "depth")]
        self.pairs = ApproximateTimeSynchronizer(topics, queue_size=2, slop=0.02)
        self.pairs.registerCallback(self.track)

    def set_camera(self, info: CameraInfo) -> None:
        """Take fx, fy, cx and cy from the projection matrix of the rectified images."""
        self.K = (info.p[0], info.p[5], info.p[2], info.p[6])

    def track(self, color: Image, depth: Image) -> None:
        """Track one pair of images."""
        scale = None if depth.encoding == "32FC1" else 1000.0
        time_s, order = color.header.stamp.sec + 1e-9 * color.header.stamp.nanosec, color.encoding[:3]
        try:
            readings = np.nan_to_num(pixels(depth), nan=0.0, posinf=0.0, neginf=0.0)  # REP 118: NaN or inf = no reading
            step = self.slam.track(pixels(color), readings, self.K, time_s, depth_scale=scale, color_order=order)
        except (SigmaSplatError, KeyError) as problem:
            return self.get_logger().warning(f"image skipped: {problem}")
        if step.covariance is not None and step.component == 0:  # not lost, and connected to the first image
            self.publish(color.header, step.T_world_camera, step.covariance)

    def publish(self, header, T_world_camera: np.ndarray, covariance: np.ndarray) -> None:
        """Publish a pose in the axes of `map`."""
        message, axes = Odometry(), np.kron(np.eye(2), R_MAP_WORLD)
        message.header.stamp, message.header.frame_id, message.child_frame_id = header.stamp, "map", header.frame_id
        p, q, turned = message.pose.pose.position, message.pose.pose.orientation, R_MAP_WORLD @ T_world_camera[:3]
        p.x, p.y, p.z = turned[:, 3].tolist()
        q.x, q.y, q.z, q.w = Rotation.from_matrix(turned[:, :3]).as_quat().tolist()
        message.pose.covariance = (axes @ covariance @ axes.T).reshape(-1)
        self.publisher.publish(message)


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    node = SlamNode()
    with interrupt_event() as stopped:  # Ctrl-C never interrupts an image
        while not stopped.is_set():
            rclpy.spin_once(node, timeout_sec=0.1)
    node.slam.finish()
    write_field(Path("map.ply"), node.slam.field)


if __name__ == "__main__":
    main()
