from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from models.motion.formats.asf_amc import read_asf_amc
from models.motion.formats.errors import (
    ChannelCountError,
    EmptyMotionError,
    FormatError,
    InvalidNumberError,
    MalformedFileError,
    TruncatedFileError,
    UnsupportedFileError,
)
from models.motion.kinematics import forward_kinematics

ASF = """# made by hand
:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name lfemur
     direction 0 -1 0
     length 8
     axis 0 0 90 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
     id 2
     name ltibia
     direction 0 -1 0
     length 7
     axis 0 0 0 XYZ
    dof rx
  end
  begin
     name lfoot
     direction 0 0 1
     length 2
     axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root lfemur
    lfemur ltibia
    ltibia lfoot
  end
"""
AMC = """#!OML:ASF
:FULLY-SPECIFIED
:DEGREES
1
root 1 16 2 0 0 0
lfemur 0 0 0
ltibia 0
2
root 1 16 2 0 90 0
lfemur 0 90 0
ltibia 90
"""
UNIT = 0.0254 / 0.45


def read(folder: Path, asf: str = ASF, amc: str = AMC):
    (folder / "a.asf").write_text(asf, encoding="utf-8")
    (folder / "a_01.amc").write_text(amc, encoding="utf-8")
    return read_asf_amc(folder / "a.asf", folder / "a_01.amc")


def test_a_joint_is_where_its_bone_starts_in_metres_with_z_up(tmp_path):
    motion = read(tmp_path)
    assert motion.skeleton.joints == ("root", "lfemur", "ltibia", "lfoot")
    assert (motion.fps, motion.num_frames) == (120.0, 2)
    standing = np.array([[2, 1, 16], [2, 1, 16], [2, 1, 8], [2, 1, 1]]) * UNIT
    np.testing.assert_allclose(motion.positions[0], standing, atol=1e-12)
    # The femur's own y axis is turned to -x: 90 about it raises the leg ahead; the root's turn to
    # the left takes that to the left; 90 about x in the knee bends it down behind, then up.
    np.testing.assert_allclose(motion.positions[1, 2], np.array([2, 9, 16]) * UNIT, atol=1e-12)


def test_rotations_and_rest_offsets_give_the_positions(tmp_path):
    motion = read(tmp_path)
    assert motion.rotations is not None
    assert motion.rest_offsets is not None
    positions = forward_kinematics(
        motion.rotations, motion.rest_offsets, motion.skeleton.parents, motion.positions[:, 0]
    )
    np.testing.assert_allclose(positions, motion.positions, atol=1e-12)


def change(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("amc", "error", "message"),
    [
        ("", EmptyMotionError, r"a_01\.amc:0: found no frame"),
        (AMC[:-10], TruncatedFileError, r":10: found a frame that ends without ltibia"),
        (AMC[:-13], TruncatedFileError, r":10: found 2 values for lfemur; .* 3"),
        (AMC[:-6], TruncatedFileError, r":11: found 'ltib'; a line must name a bone"),
        (change(AMC, "ltibia 0\n", ""), MalformedFileError, "ends without ltibia"),
        (change(AMC, "ltibia 0", "ltibia 0 1"), ChannelCountError, r":7: found 2 values"),
        (change(AMC, "ltibia 0", "lfoot 0"), MalformedFileError, r":7: found 'lfoot'"),
        (change(AMC, "ltibia 0", "ltibia nan"), InvalidNumberError, r":7: found 'nan'"),
        (change(AMC, "ltibia 0", "root 0"), MalformedFileError, r":7: found 'root'"),
        (change(AMC, "\n1\n", "\n"), MalformedFileError, r":4: found 'root'"),
        (change(AMC, ":DEGREES", ":RADIANS"), UnsupportedFileError, r":3: found :RADIANS"),
    ],
)
def test_a_damaged_amc_is_refused_with_the_place(tmp_path, amc, error, message):
    with pytest.raises(error, match=message):
        read(tmp_path, amc=amc)


@pytest.mark.parametrize(
    ("asf", "error", "message"),
    [
        (ASF[: ASF.index(":hierarchy")], TruncatedFileError, "found no :hierarchy"),
        (ASF[:-12], TruncatedFileError, r"a\.asf:42: .* must close with end"),
        (change(ASF, "    ltibia lfoot\n", ""), TruncatedFileError, "2 bones in :hierarchy"),
        (change(ASF, "length 8", ""), MalformedFileError, "a bone without length"),
        (change(ASF, "length 8", "length x"), InvalidNumberError, r"a\.asf:17: found 'x'"),
        (change(ASF, "length 0.45", "length 0"), MalformedFileError, "positive"),
        (change(ASF, "0 0 90 XYZ", "0 0 90"), MalformedFileError, "an order such as XYZ"),
        (change(ASF, "dof rx ry rz", "dof rx l"), UnsupportedFileError, "found rx l"),
        (change(ASF, "TX TY TZ", "TX"), UnsupportedFileError, "the root must have"),
        (change(ASF, "name ltibia", "name lfemur"), MalformedFileError, "second 'lfemur'"),
        (change(ASF, "root lfemur", "root ltoes"), MalformedFileError, "'ltoes' below 'root'"),
        (change(ASF, "0 -1 0", "0 -1"), MalformedFileError, "3 numbers must follow"),
        (change(ASF, "bonedata\n  begin", "bonedata\n"), MalformedFileError, "begin and end"),
    ],
)
def test_a_damaged_asf_is_refused_with_the_place(tmp_path, asf, error, message):
    with pytest.raises(error, match=message):
        read(tmp_path, asf=asf)


@settings(max_examples=300,
          suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
@given(st.data())
def test_garbage_is_read_or_refused_but_never_breaks_the_reader(tmp_path, data):
    files = {"a.asf": bytearray(ASF.encode()), "a.amc": bytearray(AMC.encode())}
    content = files[data.draw(st.sampled_from(sorted(files)))]
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    del content[data.draw(st.integers(0, len(content))) :]
    for name, bytes_ in files.items():
        (tmp_path / name).write_bytes(bytes(bytes_))
    try:
        positions = read_asf_amc(tmp_path / "a.asf", tmp_path / "a.amc").positions
    except FormatError as error:
        positions, message = np.zeros(3), str(error)
    else:
        message = "a.a"
    assert message.startswith("a.a")
    assert np.isfinite(positions).all()
