"""Motion files by their suffix."""

from pathlib import Path

from models.motion.formats.asf_amc import read_asf_amc
from models.motion.formats.bvh import read_bvh
from models.motion.formats.errors import UnsupportedFileError
from models.motion.formats.npz import read_archive
from models.motion.motion import Motion

SUFFIXES = (".bvh", ".amc", ".npz")


def read_motion(path: Path) -> Motion:
    """The motion of a BVH file, of an AMC file beside its ASF, or of an archive of one clip.

    Raises:
        FormatError: The file is of another kind, damaged, or without its ASF.
    """
    match path.suffix.lower():
        case ".bvh":
            return read_bvh(path)
        case ".amc":
            return read_asf_amc(_asf_beside(path), path)
        case ".npz":
            clips = list(read_archive(path))
            if len(clips) == 1:
                return clips[0].motion
            found, right = f"{len(clips)} clips", "use read_archive for more than one"
        case suffix:
            found, right = f"the suffix {suffix!r}", f"it must be one of {', '.join(SUFFIXES)}"
    raise UnsupportedFileError(path.name, found=found, right=right)


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
