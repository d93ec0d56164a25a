"""A pose_landmarker.task of our own, small enough to be written by a test, for MediaPipe to run.

Google's models are no part of this project, and a person in front of a camera is no part of a test.
MediaPipe itself is: so these two networks have the shapes of Google's, but see in each picture one
person in its middle, whose right arm is raised the more the redder the picture is.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import flatbuffers
import numpy as np

SURE = 12.0  # before the sigmoid
DETECTOR_PIXELS, LANDMARK_PIXELS = 224, 256
NUM_ANCHORS = 2 * (28**2 + 14**2) + 6 * 7**2
NUM_LANDMARKS, NUM_OTHERS = 33, 6  # the others are where to look in the next picture
RIGHT_ELBOW, RIGHT_WRIST = 14, 16
ARM_M = (0.25, 0.5)  # by which elbow and wrist rise when all is red

# TensorFlow Lite's schema: a table is {slot: value}, an enum its number.
AVERAGE_POOL_2D, CONV_2D, FULLY_CONNECTED, RESHAPE = 1, 3, 9, 22
POOL_OPTIONS, CONV_OPTIONS, FULLY_CONNECTED_OPTIONS, RESHAPE_OPTIONS = 5, 1, 8, 17
OPERATORS = (AVERAGE_POOL_2D, CONV_2D, FULLY_CONNECTED, RESHAPE)
FLOAT32, INT32 = np.int8(0), np.int8(2)
VALID = np.int8(1)


def write_pose_task(path: Path, body: np.ndarray) -> None:
    """Write networks for which a person's landmarks are ``body`` (33, 3), as MediaPipe has them."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as task:
        task.writestr("pose_detector.tflite", _detector())
        task.writestr("pose_landmarks_detector.tflite", _landmarks(body))


def _detector() -> bytes:
    boxes = np.zeros((NUM_ANCHORS, 12))
    boxes[0] = _one_person_at(0.5 / 28)
    scores = np.full((NUM_ANCHORS, 1), -SURE)
    scores[0] = SURE
    network = _Network(DETECTOR_PIXELS)
    network.values(boxes[None])
    network.values(scores[None])
    return network.written()


def _one_person_at(anchor: float) -> list[float]:
    """The middle and size of a box, and of the hips and of the circle around the person, in pixels.

    All but the size as seen from an anchor, which is this far, in pictures, from the upper left.
    """
    middle, above = (0.5 - anchor) * DETECTOR_PIXELS, (0.05 - anchor) * DETECTOR_PIXELS
    size = 0.9 * DETECTOR_PIXELS
    return [middle, middle, size, size, middle, middle, middle, above, *[middle] * 4]


def _landmarks(body: np.ndarray) -> bytes:
    count = NUM_LANDMARKS + NUM_OTHERS
    world = np.zeros((count, 3))
    world[:NUM_LANDMARKS] = body
    seen = np.full((count, 5), SURE)  # x, y, z, how visible and how present
    seen[:, :3] = 0.5 * LANDMARK_PIXELS + 0.4 * LANDMARK_PIXELS * world
    top = seen[NUM_LANDMARKS + 1]
    top[1] -= 0.4 * LANDMARK_PIXELS  # of the circle to look within
    raised = np.zeros((count, 3))
    raised[[RIGHT_ELBOW, RIGHT_WRIST], 1] = np.negative(ARM_M)
    network = _Network(LANDMARK_PIXELS)
    network.values(seen.reshape(1, -1))
    network.values(np.full((1, 1), SURE))
    network.map(256, 1, 0.0)  # where the person is
    network.map(64, count, -SURE)  # where each landmark is, which refines it
    network.values(world.reshape(1, -1), raised)
    return network.written()


class _Network:
    """A network of one picture, written one output after the other."""

    def __init__(self, pixels: int) -> None:
        self._pixels = pixels
        self._buffers: list[dict[int, Any]] = [{}]
        self._tensors: list[dict[int, Any]] = []
        self._operators: list[dict[int, Any]] = []
        self._outputs: list[int] = []
        self._picture = self._tensor((1, pixels, pixels, 3))
        self._mean = self._tensor((1, 1, 1, 3))
        pooled = {0: VALID, 1: pixels, 2: pixels, 3: pixels, 4: pixels}
        self._operate(AVERAGE_POOL_2D, [self._picture], self._mean, POOL_OPTIONS, pooled)

    def values(self, constant: np.ndarray, by_red: np.ndarray | None = None) -> None:
        """Values that are the same for all pictures, and this much more where all is red."""
        weights = np.zeros((constant.size, 3))
        if by_red is not None:
            weights[:, 0] = by_red.ravel()
        flat = self._tensor((1, constant.size))
        inputs = [self._mean, self._known(weights), self._known(constant.ravel())]
        self._operate(FULLY_CONNECTED, inputs, flat, FULLY_CONNECTED_OPTIONS, {})
        shape = np.array(constant.shape, np.int32)
        self._outputs.append(self._tensor(constant.shape))
        reshaped = [flat, self._known(shape)]
        self._operate(RESHAPE, reshaped, self._outputs[-1], RESHAPE_OPTIONS, {0: shape})

    def map(self, size: int, channels: int, value: float) -> None:
        """A picture of one value all over."""
        stride = self._pixels // size
        weights = np.zeros((channels, stride, stride, 3))
        inputs = [self._picture, self._known(weights), self._known(np.full(channels, value))]
        self._outputs.append(self._tensor((1, size, size, channels)))
        options = {0: VALID, 1: stride, 2: stride}
        self._operate(CONV_2D, inputs, self._outputs[-1], CONV_OPTIONS, options)

    def written(self) -> bytes:
        self._buffers.append({0: np.frombuffer(_metadata(), np.uint8)})
        inputs, outputs = _ints([self._picture]), _ints(self._outputs)
        graph = {0: self._tensors, 1: inputs, 2: outputs, 3: self._operators, 4: "main"}
        metadata = {0: "TFLITE_METADATA", 1: np.uint32(len(self._buffers) - 1)}
        codes = [{0: np.int8(code), 3: code} for code in OPERATORS]
        return _written(
            {0: np.uint32(3), 1: codes, 2: [graph], 4: self._buffers, 6: [metadata]}, b"TFL3"
        )

    def _tensor(self, shape: Sequence[int], *, kind: np.int8 = FLOAT32, buffer: int = 0) -> int:
        name = f"tensor {len(self._tensors)}"
        self._tensors.append({0: _ints(shape), 1: kind, 2: np.uint32(buffer), 3: name})
        return len(self._tensors) - 1

    def _known(self, values: np.ndarray) -> int:
        whole = values.dtype == np.int32
        data = values if whole else values.astype(np.float32)
        self._buffers.append({0: np.frombuffer(data.tobytes(), np.uint8)})
        return self._tensor(
            values.shape, kind=INT32 if whole else FLOAT32, buffer=len(self._buffers) - 1
        )

    def _operate(
        self, code: int, inputs: Sequence[int], output: int, kind: int, options: dict[int, Any]
    ) -> None:
        place = np.uint32(OPERATORS.index(code))
        self._operators.append(
            {0: place, 1: _ints(inputs), 2: _ints([output]), 3: np.uint8(kind), 4: options}
        )


def _metadata() -> bytes:
    """Tells that pictures come as 0 to 1."""
    normalised = {0: np.zeros(1, np.float32), 1: np.full(1, 255.0, np.float32)}
    picture = {0: "picture", 4: [{0: np.uint8(1), 1: normalised}]}
    return _written({0: "pose", 3: [{2: [picture]}]}, b"M001")


def _ints(values: Sequence[int]) -> np.ndarray:
    return np.array(values, np.int32)


def _written(table: dict[int, Any], identifier: bytes) -> bytes:
    builder = flatbuffers.Builder(1024)
    builder.Finish(_table(builder, table), file_identifier=identifier)
    return bytes(builder.Output())


def _table(builder: flatbuffers.Builder, slots: dict[int, Any]) -> int:
    """A table and what it refers to, which has to be written before it."""
    referred = {slot: _referred(builder, value) for slot, value in slots.items()}
    builder.StartObject(max(slots, default=-1) + 1)
    for slot, value in slots.items():
        if referred[slot] is not None:
            builder.PrependUOffsetTRelativeSlot(slot, referred[slot], 0)
            continue
        prepend = {np.int8: "Int8", np.uint8: "Uint8", np.uint32: "Uint32", int: "Int32"}
        getattr(builder, f"Prepend{prepend[type(value)]}Slot")(slot, int(value), 0)
    return int(builder.EndObject())


def _referred(builder: flatbuffers.Builder, value: Any) -> int | None:
    if isinstance(value, str):
        return int(builder.CreateString(value))
    if isinstance(value, dict):
        return _table(builder, value)
    if isinstance(value, np.ndarray):
        return int(builder.CreateNumpyVector(value))
    if isinstance(value, list):
        tables = [_table(builder, each) for each in value]
        builder.StartVector(4, len(tables), 4)
        for table in reversed(tables):
            builder.PrependUOffsetTRelative(table)
        return int(builder.EndVector())
    return None
