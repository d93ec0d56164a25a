"""A ROS 2 node: the TF frames of a tracked body, or a PoseArray, in; markers of futures out."""

import rclpy
from conversion import (
    REP155_LINKS,
    markers,
    pose_of_array,
    pose_of_transforms,
    seconds,
    skeleton,
)
from geometry_msgs.msg import Point, PoseArray
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header
from tf2_ros import Buffer, TransformException, TransformListener
from visualization_msgs.msg import Marker, MarkerArray

from models.motion.skeleton import BODY21
from service.asking.exchange import ProblemError
from service.client import Client


class Futures(Node):
    """Pushes what is seen into one live stream, and publishes what comes back."""

    def __init__(self) -> None:
        super().__init__("posefutures")
        url = self.declare_parameter("url", "http://localhost:8000").value
        self.world = self.declare_parameter("frame_id", "map").value
        self.body_id = self.declare_parameter("body_id", "").value
        own = {
            "joints": list(self.declare_parameter("joints", list(BODY21.joints)).value),
            "parents": list(self.declare_parameter("parents", list(BODY21.parents)).value),
        }
        self.skeleton = skeleton() if self.body_id else own
        self.seen_s = 0.0
        self.publisher = self.create_publisher(MarkerArray, "futures", 1)
        self.client = Client(url)
        self.live = self.client.live(
            rate_hz=self.declare_parameter("rate_hz", 10.0).value,
            num_samples=self.declare_parameter("num_samples", 20).value,
            skeleton=self.skeleton,
            returned=["futures", "modes"],
        )
        self.live.__enter__()
        if self.body_id:
            self.transforms = Buffer()
            self.listener = TransformListener(self.transforms, self)
            self.create_timer(1.0 / 30.0, self.look)
        else:
            self.create_subscription(PoseArray, "poses", self.see, 10)
        self.create_timer(0.02, self.publish)

    def look(self) -> None:
        """Push the body's links as TF has them now."""
        found, stamps = {}, []
        for link in REP155_LINKS:
            frame = f"{link}_{self.body_id}"
            try:
                known = self.transforms.lookup_transform(self.world, frame, Time())
            except TransformException:
                continue
            found[frame] = known.transform.translation
            stamps.append(seconds(known.header.stamp))
        if found and max(stamps) > self.seen_s:
            self.seen_s = max(stamps)
            self.live.push(pose_of_transforms(found, self.body_id), self.seen_s)

    def see(self, message: PoseArray) -> None:
        """Push the poses of a PoseArray, the joints in the order of the parameter ``joints``."""
        self.world = message.header.frame_id
        pose = pose_of_array(message, num_joints=len(self.skeleton["joints"]))
        self.live.push(pose, seconds(message.header.stamp))

    def publish(self) -> None:
        """Publish the newest futures, if there are any that were not."""
        try:
            newest = self.live.latest()
        except ProblemError as problem:
            self.get_logger().warning(str(problem))
            return
        if newest is None:
            return
        prediction = newest.prediction
        header = Header(frame_id=self.world, stamp=self.get_clock().now().to_msg())
        modes = prediction.modes
        drawn = markers(
            [prediction.futures[mode.sample] for mode in modes],
            parents=self.skeleton["parents"],
            header=header,
            marker=Marker,
            point=Point,
            probabilities=[mode.probability for mode in modes],
        )
        self.publisher.publish(MarkerArray(markers=drawn))

    def destroy_node(self) -> None:
        """Close the stream."""
        self.live.__exit__(None, None, None)
        self.client.close()
        super().destroy_node()


def main() -> None:
    """Run until it is told to end."""
    rclpy.init()
    node = Futures()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
