from pathlib import Path

import ezc3d
import numpy as np
import pytest
from tiny_bundles import walking

from models.motion.axes import Axes
from models.motion.formats.errors import (
    ChannelCountError,
    EmptyMotionError,
    FormatError,
    InvalidNumberError,
    MalformedFileError,
    TruncatedFileError,
    UnsupportedFileError,
)
from models.motion.formats.files import read_motion
from models.motion.skeleton import BODY21

WALK = walking(12)
MARKERS = ["LASI", "RASI", "LPSI", "RPSI", "LKNE", "RKNE", "LANK", "RANK"]
UNSEEN = (4, BODY21.index("left_hand"))


def trc(points: np.ndarray, labels: list[str], units: str = "mm", rate: float = 50.0) -> str:
    names = "\t\t\t".join(labels)
    axes = "\t".join(f"{axis}{i + 1}" for i in range(len(labels)) for axis in "XYZ")
    rows = []
    for frame, row in enumerate(points):
        cells = ["" if np.isnan(x) else f"{x:.5f}" for x in row.ravel()]
        rows.append("\t".join([str(frame + 1), f"{frame / rate:.5f}", *cells]))
    return "\n".join(
        [
            "PathFileType\t4\t(X/Y/Z)\tx.trc",
            "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate",
            f"{rate}\t{rate}\t{len(points)}\t{len(labels)}\t{units}\t{rate}",
            f"Frame#\tTime\t{names}\t\t",
            f"\t\t{axes}",
            *rows,
        ]
    )


def c3d(path: Path, points: np.ndarray, labels: list[str], units: str = "mm") -> Path:
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [50.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = tuple(labels)
    file["parameters"]["POINT"]["UNITS"]["value"] = (units,)
    homogeneous = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1)
    file["data"]["points"] = homogeneous.transpose(2, 1, 0)
    file.write(str(path))
    return path


def sent(axes: Axes) -> np.ndarray:
    points = axes.from_metres(WALK)
    points[UNSEEN] = np.nan
    return points


def assert_walks(path: Path) -> None:
    motion = read_motion(path)
    assert motion.fps == 50.0
    order = [motion.skeleton.index(f"Anna:{joint}") for joint in BODY21.joints]
    found = motion.positions[:, order]
    assert np.argwhere(np.isnan(found[..., 0])).tolist() == [list(UNSEEN)]
    expected = WALK.copy()
    expected[UNSEEN] = np.nan
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize(
    ("axes", "units"),
    [
        (Axes(up="y", units="mm"), "mm"),
        (Axes(up="z", units="m"), "m"),
        (Axes(up="y", units="cm"), "Furlong"),
    ],
)
@pytest.mark.parametrize("suffix", ["trc", "c3d"])
def test_joints_come_as_they_are_named(tmp_path: Path, suffix: str, axes: Axes, units: str):
    labels = [f"Anna:{joint}" for joint in BODY21.joints]
    path = tmp_path / f"x.{suffix}"
    if suffix == "c3d":
        c3d(path, sent(axes), labels, units)
    else:
        path.write_text(trc(sent(axes), labels, units))
    assert_walks(path)


def test_points_without_a_name_and_never_seen_are_left_out(tmp_path: Path):
    extra = np.concatenate([WALK, WALK[:, :2]], axis=1)
    extra[:, 21] = np.nan
    path = tmp_path / "x.trc"
    path.write_text(trc(extra, [*BODY21.joints, "nose", "*22"], "m"))
    assert set(read_motion(path).skeleton.joints) == set(BODY21.joints)


@pytest.mark.parametrize("suffix", ["trc", "c3d"])
def test_markers_are_no_joints_and_are_named(tmp_path: Path, suffix: str):
    path = tmp_path / f"x.{suffix}"
    if suffix == "c3d":
        c3d(path, WALK[:, :8] * 1e3, MARKERS)
    else:
        path.write_text(trc(WALK[:, :8] * 1e3, MARKERS))
    with pytest.raises(UnsupportedFileError, match=r"the points LASI, RASI, .* RANK.*joints"):
        read_motion(path)


GOOD = trc(WALK, list(BODY21.joints), "m")


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("", TruncatedFileError, r"x\.trc:0: found the end"),
        (GOOD.replace("DataRate", "Rate"), MalformedFileError, "no DataRate"),
        (
            GOOD.replace("50.0\t50.0", "fast\t50.0", 1),
            InvalidNumberError,
            r"x\.trc:3: found 'fast'",
        ),
        (GOOD.replace("50.0\t50.0", "0\t50.0", 1), InvalidNumberError, "must be positive"),
        (GOOD + "\t7", ChannelCountError, r":17: found 64 values; 21 points have 63"),
        (GOOD.replace("0.96000", "x", 1), InvalidNumberError, r":6: found 'x'"),
        ("\n".join(GOOD.split("\n")[:5]), EmptyMotionError, "no frames"),
        (
            "\n".join([*GOOD.split("\n")[:3], "Frame#\tTime", " ", " "]),
            MalformedFileError,
            "no labels",
        ),
    ],
)
def test_damaged_table_is_refused_with_the_place(tmp_path: Path, text, error, message):
    path = tmp_path / "x.trc"
    path.write_text(text)
    with pytest.raises(error, match=message):
        read_motion(path)


def test_damaged_c3d_is_refused(tmp_path: Path):
    path = c3d(tmp_path / "x.c3d", WALK * 1e3, list(BODY21.joints))
    whole = path.read_bytes()
    path.write_bytes(b"no C3D")
    with pytest.raises(MalformedFileError, match="must be a C3D"):
        read_motion(path)
    path.write_bytes(whole[:600])
    with pytest.raises(FormatError, match=r"x\.c3d"):
        read_motion(path)
