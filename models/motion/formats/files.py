"""Motion files by their suffix."""

from pathlib import Path

from models.motion.formats.asf_amc import read_asf_amc
from models.motion.formats.bvh import read_bvh, write_bvh
from models.motion.formats.c3d import read_c3d
from models.motion.formats.errors import UnsupportedFileError
from models.motion.formats.gltf import write_glb
from models.motion.formats.plain_npz import read_npz, write_npz
from models.motion.formats.pose_json import read_json, write_json
from models.motion.formats.trc import read_trc
from models.motion.gaps import without_gaps
from models.motion.motion import Motion

SUFFIXES = (".bvh", ".amc", ".npz", ".json", ".c3d", ".trc")
WRITTEN_SUFFIXES = (".bvh", ".glb", ".npz", ".json")


def read_motion(path: Path) -> Motion:
    """The motion of a file of one of ``SUFFIXES``, or of a folder of OpenPose's frames.

    An AMC file has its ASF beside it.

    Raises:
        FormatError: The file is of another kind, damaged, or without its ASF.
    """
    if path.is_dir():
        return read_json(path)
    match path.suffix.lower():
        case ".bvh":
            return read_bvh(path)
        case ".amc":
            return read_asf_amc(_asf_beside(path), path)
        case ".npz":
            return read_npz(path)
        case ".json":
            return read_json(path)
        case ".c3d":
            return read_c3d(path)
        case ".trc":
            return read_trc(path)
        case suffix:
            raise _unsupported(path, suffix, SUFFIXES)


def write_motion(path: Path, motion: Motion) -> None:
    """Writes a motion as the kind of file that the suffix says, one of ``WRITTEN_SUFFIXES``.

    BVH and GLB have no gaps: what was not seen is carried along by the body, or left out where it
    never was.

    Raises:
        UnsupportedFileError: The suffix is another.
    """
    match path.suffix.lower():
        case ".bvh":
            write_bvh(path, without_gaps(motion))
        case ".glb":
            write_glb(path, without_gaps(motion))
        case ".npz":
            write_npz(path, motion)
        case ".json":
            write_json(path, motion)
        case suffix:
            raise _unsupported(path, suffix, WRITTEN_SUFFIXES)


def _unsupported(path: Path, suffix: str, known: tuple[str, ...]) -> UnsupportedFileError:
    found = f"the suffix {suffix!r}" if suffix else "no suffix"
    return UnsupportedFileError(
        path.name, found=found, right=f"it must be one of {', '.join(known)}"
    )


def _asf_beside(path: Path) -> Path:
    """The ASF of the same subject: `03_01.amc` goes with `03_01.asf` or `03.asf`."""
    words = path.stem.split("_")
    stems = ["_".join(words[:n]) for n in range(len(words), 0, -1)]
    candidates = {p.name.lower(): p for p in path.parent.iterdir()}
    for stem in stems:
        if found := candidates.get(f"{stem}.asf".lower()):
            return found
    raise UnsupportedFileError(
        path.name, found="no skeleton beside it", right=f"{stems[-1]}.asf must be there"
    )
