"""List the public data sets (addresses, sizes, licences), and find them by name.

The addresses are those in the download scripts of public SLAM repositories (MASt3R-SLAM's and monodepth2's for TUM,
NICE-SLAM's and pySLAM's download_replica.sh, cuVSLAM's download_icl_nuim.sh, hloc's README for 7-Scenes, WildGS-SLAM's
download_bonn.sh, Open3D's RedwoodIndoor*.cpp). Only Open3D publishes checksums. The checksums of TUM and 7-Scenes were
recorded by two independent projects with equal results. Other sizes are approximate.
"""

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from urllib.parse import urlsplit

from rich.filesize import decimal

from sigmasplat.api import DownloadError


@dataclass(frozen=True)
class RemoteFile:
    """A file on a server: an archive, recognised by its name, or a plain file.

    size_bytes: of the download, None if not published; checksum: "sha256:…" or "md5:…", or the start of one, or "" if
    unknown, and then the size is approximate; into: the folder it is unpacked to, below the recording's folder (for a
    plain file: its name); nested: whether it contains further archives.
    """

    url: str
    size_bytes: int | None = None
    checksum: str = ""
    into: str = ""
    nested: bool = False

    @property
    def name(self) -> str:
        """Return the file name on the server."""
        return PurePosixPath(urlsplit(self.url).path).name


@dataclass(frozen=True)
class PublicRecording:
    """One download: the contents of `archives` form `folder`; `start` is the first sequence below it."""

    folder: str
    archives: tuple[RemoteFile, ...]
    start: str = ""

    @property
    def size_bytes(self) -> int | None:
        """Return the total size of the downloads, None if one of them is unknown."""
        sizes = [archive.size_bytes for archive in self.archives]
        return None if None in sizes else sum(size or 0 for size in sizes)


@dataclass(frozen=True)
class PublicSet:
    """A data set that can be downloaded without registration.

    folder: below the data folder; recordings: by short name, "" if there is only one; disk_ratio: bytes on disk during
    unpacking, per byte of the archive; prefix: optional prefix of the short names; sequences: whether the recordings
    are sequences, not weights.
    """

    title: str
    page: str
    licence: str
    folder: str
    recordings: Mapping[str, PublicRecording]
    disk_ratio: float = 1.3
    prefix: str = ""
    sequences: bool = True


@dataclass(frozen=True)
class RestrictedSet:
    """A data set available only on request; page: where to apply."""

    title: str
    page: str


MB = 10**6

_UNKNOWN_SIZES = (
    "fr2/large_no_loop fr2/pioneer_360 fr2/pioneer_slam fr2/pioneer_slam2 fr2/pioneer_slam3 "
    "fr3/nostructure_notexture_far fr3/nostructure_notexture_near_withloop fr3/nostructure_texture_far "
    "fr3/nostructure_texture_near_withloop fr3/structure_notexture_far fr3/structure_notexture_near "
    "fr3/structure_texture_far fr3/structure_texture_near fr2/coke fr2/dishes fr2/flowerbouquet "
    "fr2/flowerbouquet_brownbackground fr2/metallic_sphere fr2/metallic_sphere2"
)
TUM_SIZES_MB: Mapping[str, int | None] = {
    "fr1/xyz": 448, "fr1/rpy": 410, "fr2/xyz": 2270, "fr2/rpy": 2020, "fr1/360": 430, "fr1/floor": 780, "fr1/desk": 344,
    "fr1/desk2": 349, "fr1/room": 782, "fr2/360_hemisphere": 1430, "fr2/360_kidnap": 700, "fr2/desk": 1893,
    "fr2/large_with_loop": 2690, "fr3/long_office_household": 1484, "fr1/plant": 700, "fr1/teddy": 880,
    "fr3/cabinet": 490, "fr3/large_cabinet": 450, "fr3/teddy": 1230, **dict.fromkeys(_UNKNOWN_SIZES.split()),
}  # fmt: skip
"""The static scenes with published ground truth, without the dynamic scenes."""

TUM_EXACT = {
    "fr1/xyz": (448_204_271, "sha256:a0236d97b8c30cd93b653656d2b6c293ff7c982a4130ef2a1a8beecdb124ef98"),
    "fr1/desk": (344_011_403, "sha256:e983d6830916e66dc4a46a71368046b149b283de87769690e7aa4e0b9483530c"),
    "fr1/desk2": (349_445_005, "sha256:a569e4cb453a3cd9285bc985fcb109e65f055c75b33a4b155acd9a68d96b77d2"),
}

SEVEN_SCENES_SIZES = {
    **{"chess": 3_079_608_937, "fire": 2_301_204_154, "heads": 956_332_240, "office": 4_707_873_861},
    **{"pumpkin": 2_890_874_911, "redkitchen": 6_141_181_406, "stairs": 1_496_412_431},
}
CHESS_SHA256 = "sha256:d00b5b8f904123ec136768ee0ebd8f72aebb5473630fb5d8ec352e70ae4859d0"
SEVEN_SCENES_URL = "https://download.microsoft.com/download/2/8/5/28564B23-0828-408F-8631-23B1EFF1DAC8"

BONN_NAMES = (
    *("balloon", "balloon2", "balloon_tracking", "balloon_tracking2", "crowd", "crowd2", "crowd3"),
    *("kidnapping_box", "kidnapping_box2", "moving_nonobstructing_box", "moving_nonobstructing_box2"),
    *("moving_obstructing_box", "moving_obstructing_box2", "person_tracking", "person_tracking2"),
    *("placing_nonobstructing_box", "placing_nonobstructing_box2", "placing_nonobstructing_box3"),
    *("placing_obstructing_box", "removing_nonobstructing_box", "removing_nonobstructing_box2"),
    *("removing_obstructing_box", "static", "static_close_far", "synchronous", "synchronous2"),
)

REDWOOD_MD5 = {
    "livingroom1": "c23481094ca3859b204d2fcbb4e435a4 2fec03a29258a29b9ffedde88fddd676 601ac4b51aba2455a90aed8aa1158c6a",
    "livingroom2": "34792f7aa35b6c8b62e394e9372b95d7 cbb4a36b8488448d79ec93c202c0c90e 193961c018f4c2a753458d5231544036",
    "office1": "6a58750880e83ac5948e0f28de294c04 7c7e479191d35c2ad1f8ac1c227f4f8d 3fac752ab38a4e8a96d1b5afa535f9f7",
    "office2": "487cdfacffc8fc8247a5b21e860a3794 13f1c5b7c4f44524fa91f7ba87e44bb5 698f2f09da7d2ed3fcb604889e6f8479",
}
"""Contains colour, depth with Kinect noise, and the path."""
REPLICA_URL = "https://cvg-data.inf.ethz.ch/nice-slam/data/Replica.zip"
REDWOOD_URL = "https://github.com/isl-org/open3d_downloads/releases/download/augmented-icl-nuim"


LPIPS_URL = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1"
TORCH_URL = "https://download.pytorch.org/models"
LPIPS_FILES = {
    "alex": (
        ("alex.pth", 6_009, "sha256:df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"),
        ("alexnet-owt-7be5be79.pth", 244_408_911, "sha256:7be5be79"),
    ),
    "vgg": (
        ("vgg.pth", 7_289, "sha256:a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"),
        ("vgg16-397923af.pth", 553_433_881, "sha256:397923af"),
    ),
}
"""For each network the linear layers of lpips 0.1.4 and torchvision's weights: name, size, checksum."""


def _lpips(net: str) -> PublicRecording:
    linear, trunk = LPIPS_FILES[net]
    files = ((LPIPS_URL, *linear), (TORCH_URL, *trunk))
    return PublicRecording(
        net, tuple(RemoteFile(f"{url}/{name}", size, digest, into=name) for url, name, size, digest in files)
    )


def _tum(name: str, rough_mb: int | None) -> PublicRecording:
    camera, scene = name.split("/")
    part = camera.replace("fr", "freiburg")
    folder = f"rgbd_dataset_{part}_{scene}"
    size_bytes, checksum = TUM_EXACT.get(name, (rough_mb and rough_mb * MB, ""))
    url = f"https://cvg.cit.tum.de/rgbd/dataset/{part}/{folder}.tgz"
    return PublicRecording(folder, (RemoteFile(url, size_bytes, checksum),))


def _icl(stem: str) -> PublicRecording:
    return PublicRecording(stem, (RemoteFile(f"https://www.doc.ic.ac.uk/~ahanda/{stem}.tar.gz"),))


def _seven_scenes(name: str, size_bytes: int) -> PublicRecording:
    checksum = CHESS_SHA256 if name == "chess" else ""
    archive = RemoteFile(f"{SEVEN_SCENES_URL}/{name}.zip", size_bytes, checksum, nested=True)
    return PublicRecording(name, (archive,), start="seq-01")


def _bonn(name: str) -> PublicRecording:
    folder = f"rgbd_bonn_{name}"
    return PublicRecording(
        folder, (RemoteFile(f"https://www.ipb.uni-bonn.de/html/projects/rgbd_dynamic2019/{folder}.zip"),)
    )


def _redwood(name: str) -> PublicRecording:
    color, depth, path = (f"md5:{digest}" for digest in REDWOOD_MD5[name].split())
    return PublicRecording(
        name,
        (
            RemoteFile(f"{REDWOOD_URL}/{name}-color.zip", None, color, into="color"),
            RemoteFile(f"{REDWOOD_URL}/{name}-depth-simulated.zip", None, depth, into="depth"),
            RemoteFile(f"{REDWOOD_URL}/{name}-traj.txt", None, path, into="trajectory.log"),
        ),
    )


SETS: Mapping[str, PublicSet | RestrictedSet] = {
    "tum": PublicSet(
        "TUM RGB-D, static scenes", "https://cvg.cit.tum.de/data/datasets/rgbd-dataset", "CC BY 4.0", "tum",
        {name: _tum(name, size) for name, size in TUM_SIZES_MB.items()}, prefix="rgbd_dataset_",
    ),
    "replica": PublicSet(
        "Replica, 8 rooms rendered for NICE-SLAM", "https://github.com/facebookresearch/Replica-Dataset",
        "Replica research licence, not for commercial use", "",
        {"": PublicRecording("replica", (RemoteFile(REPLICA_URL, 12_400 * MB),), start="room0")},
    ),
    "icl": PublicSet(
        "ICL-NUIM, synthetic, as TUM-compatible PNGs", "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html",
        "terms and citation on its page", "icl",
        {f"living_room{i}": _icl(f"living_room_traj{i}_frei_png") for i in range(4)}
        | {f"office{i}": _icl(f"traj{i}_frei_png") for i in range(4)},
    ),
    "7scenes": PublicSet(
        "7-Scenes", "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
        "Microsoft Research licence, not for commercial use", "7scenes",
        {name: _seven_scenes(name, size) for name, size in SEVEN_SCENES_SIZES.items()}, disk_ratio=2.4,
    ),
    "bonn": PublicSet(
        "Bonn RGB-D Dynamic", "https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/",
        "for research, terms and citation on its page", "bonn",
        {name: _bonn(name) for name in BONN_NAMES}, prefix="rgbd_bonn_",
    ),
    "redwood": PublicSet(
        "Redwood, ICL-NUIM rooms with longer paths and Kinect noise", "http://redwood-data.org/indoor/dataset.html",
        "terms and citation on its page", "redwood", {name: _redwood(name) for name in REDWOOD_MD5},
    ),
    "lpips": PublicSet(
        "Weights of LPIPS: linear layers, and AlexNet or VGG16 of torchvision",
        "https://github.com/richzhang/PerceptualSimilarity", "BSD 2-Clause (lpips), BSD 3-Clause (torchvision)",
        "lpips", {net: _lpips(net) for net in LPIPS_FILES}, disk_ratio=1.0, sequences=False,
    ),
    "scannet": RestrictedSet("ScanNet", "http://www.scan-net.org (terms of use to sign)"),
    "scannetpp": RestrictedSet(
        "ScanNet++", "https://scannetpp.mlsg.cit.tum.de/scannetpp/ (an account and an application)"
    ),
}  # fmt: skip


def find_recording(set_name: str, recording: str = "") -> tuple[PublicSet, str]:
    """Return a data set and the short name of one of its recordings, "" if it has only one.

    Names may be written as in papers and files: freiburg1_desk, fr1_desk, rgbd_dataset_freiburg1_desk.
    Raises DownloadError if there is no such data set or recording, or if it is available only on request.
    """
    public_set = _find_set(set_name)
    if set(public_set.recordings) == {""}:
        if recording:
            raise DownloadError(f"{set_name} is one archive, without a recording {recording!r}; leave out the name")
        return public_set, ""
    names = {_normalised(name, public_set.prefix): name for name in public_set.recordings}
    known = names.get(_normalised(recording, public_set.prefix))
    if known is None:
        wanted = f"no recording {recording!r} in {set_name}" if recording else f"give a recording of {set_name}"
        raise DownloadError(f"{wanted}; {_suggestion(recording, list(public_set.recordings))}")
    return public_set, known


def describe_sets() -> Iterator[str]:
    """Yield a line per data set: name, title, number of recordings, licence."""
    for name, entry in sorted(SETS.items()):
        if isinstance(entry, PublicSet):
            many = len(entry.recordings)
            count = f"{many} recordings" if many > 1 else f"one archive, {format_size(entry.recordings[''].size_bytes)}"
            yield f"{name:<10} {entry.title} · {count} · {entry.licence}"
        else:
            yield f"{name:<10} {entry.title} · on request: {entry.page}"


def describe_recordings(set_name: str) -> Iterator[str]:
    """Yield a line per recording of a data set: name and size. Raises DownloadError if there is no such data set."""
    for name, recording in _find_set(set_name).recordings.items():
        yield f"{name or recording.folder:<36} {format_size(recording.size_bytes)}"


def format_size(size_bytes: int | None) -> str:
    """Format a number of bytes with a unit; None gives "size not published"."""
    return "size not published" if size_bytes is None else decimal(size_bytes)


def _find_set(set_name: str) -> PublicSet:
    entry = SETS.get(set_name.lower())
    if isinstance(entry, PublicSet):
        return entry
    if entry is None:
        raise DownloadError(f"no data set {set_name!r}; {_suggestion(set_name, sorted(SETS))}")
    raise DownloadError(
        f"{entry.title} is available only on request: apply at {entry.page}, then `sigmasplat run FOLDER`"
    )


def _normalised(name: str, prefix: str) -> str:
    """Normalise a name: fr1/desk, freiburg1_desk and rgbd_dataset_freiburg1_desk are equal."""
    written = name.lower().removeprefix(prefix).replace("freiburg", "fr")
    return written.replace("/", "_").replace("-", "_")


def _suggestion(wanted: str, names: list[str]) -> str:
    near = difflib.get_close_matches(wanted, names, n=3) if wanted else []
    return f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(names)}"
