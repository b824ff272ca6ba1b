"""A recording is there whole or not at all; the second time nothing is downloaded; every address is usable."""

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import file_server as acts
from archives import folder_content, tar_gz, zipped
from file_server import FileServer, serving
from sigmasplat.download import describe_recordings, describe_sets, download_recording, find_recording
from sigmasplat.download.catalogue import SETS
from sigmasplat.download.downloader import MARKER
from sigmasplat.download.entries import PublicRecording, PublicSet, RemoteFile
from sigmasplat.download.fetch import RetryPolicy
from sigmasplat.errors import DownloadError

HASTY = RetryPolicy(max_attempts=2, first_wait_s=0.001)
FILES = {"rgb.txt": b"# colour\n", "rgb/1.png": bytes(i * i % 251 for i in range(5000))}
PUBLIC = [entry for entry in SETS.values() if isinstance(entry, PublicSet)]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with serving() as server:
        server.files["/desk.tgz"] = tar_gz({f"desk/{name}": content for name, content in FILES.items()})
        yield server


def public_set(server: FileServer, *archives: RemoteFile, start: str = "") -> PublicSet:
    """Describe a set of one recording, `desk`; by default of /desk.tgz of the server."""
    made = archives or (RemoteFile(server.url("/desk.tgz")),)
    return PublicSet("Test", "http://page", "free", "test", {"desk": PublicRecording("desk", made, start)}, 2**20, 20)


def obtained(public: PublicSet, out: Path, **options: bool) -> dict[str, bytes]:
    """Obtain `desk`; return its files without our mark."""
    folder = download_recording(public, "desk", out, lambda *counts: None, retry=HASTY, **options)
    assert folder == out / "test" / "desk"
    files = folder_content(folder)
    assert json.loads(files.pop(MARKER))["recording"] == "desk"
    return files


def test_a_recording_is_downloaded_and_unpacked_out_of_its_wrapping(server: FileServer, tmp_path: Path) -> None:
    assert obtained(public_set(server), tmp_path) == FILES
    assert sorted(path.name for path in (tmp_path / "test").iterdir()) == ["desk", "desk.tgz.sha256"]


def test_the_second_time_nothing_is_downloaded(server: FileServer, tmp_path: Path) -> None:
    obtained(public_set(server), tmp_path)
    requests = list(server.ranges)
    assert obtained(public_set(server), tmp_path) == FILES
    assert server.ranges == requests


def test_terms_and_size_come_first(server: FileServer, tmp_path: Path) -> None:
    told: list[str] = []
    size = len(server.files["/desk.tgz"])
    public = public_set(server, RemoteFile(server.url("/desk.tgz"), size))
    download_recording(public, "desk", tmp_path, lambda *counts: told.append("bytes"), told.append)
    assert told[0].startswith("Test desk: ") and told[0].endswith(f"→ {tmp_path / 'test' / 'desk'}")
    assert told[1].startswith("terms: free (http://page)") and told[2] == "bytes"


def test_an_archive_is_kept_where_asked_and_used_again(server: FileServer, tmp_path: Path) -> None:
    obtained(public_set(server), tmp_path, keep_archive=True)
    assert (tmp_path / "test/desk.tgz").read_bytes() == server.files["/desk.tgz"]
    requests = list(server.ranges)
    assert obtained(public_set(server), tmp_path, overwrite=True) == FILES
    assert server.ranges == requests


def test_overwriting_replaces_all_of_it(server: FileServer, tmp_path: Path) -> None:
    obtained(public_set(server), tmp_path)
    (tmp_path / "test/desk/left over").write_text("")
    assert obtained(public_set(server), tmp_path, overwrite=True) == FILES


def test_several_archives_make_a_folder(server: FileServer, tmp_path: Path) -> None:
    server.files |= {"/c.zip": zipped({"1.jpg": b"c", "2.jpg": b"d"}), "/d.zip": zipped({"w/1.png": b"d"})}
    server.files["/path.txt"] = b"0 0 0\n"
    parts = (
        RemoteFile(server.url("/c.zip"), into="color"),
        RemoteFile(server.url("/d.zip"), into="depth"),
        RemoteFile(server.url("/path.txt"), into="trajectory.log"),
    )
    assert obtained(public_set(server, *parts, start="color"), tmp_path) == {
        "color/1.jpg": b"c",
        "color/2.jpg": b"d",
        "depth/1.png": b"d",
        "trajectory.log": b"0 0 0\n",
    }


def test_archives_within_an_archive_are_unpacked_too(server: FileServer, tmp_path: Path) -> None:
    inner = zipped({"seq-01/frame.png": FILES["rgb/1.png"], "seq-01/Thumbs.db": b"x"})
    server.files["/desk.zip"] = zipped({"desk/seq-01.zip": inner, "desk/TestSplit.txt": b"1"})
    public = public_set(server, RemoteFile(server.url("/desk.zip"), nested=True), start="seq-01")
    assert obtained(public, tmp_path) == {"seq-01/frame.png": FILES["rgb/1.png"], "TestSplit.txt": b"1"}


def checksum(algorithm: str, content: bytes) -> str:
    return f"{algorithm}:{hashlib.new(algorithm, content).hexdigest()}"


@pytest.mark.parametrize("algorithm", ["sha256", "md5"])
def test_a_published_checksum_decides(algorithm: str, server: FileServer, tmp_path: Path) -> None:
    content = server.files["/desk.tgz"]
    archive = RemoteFile(server.url("/desk.tgz"), len(content), checksum(algorithm, content))
    server.files["/desk.tgz"] = content[:99] + bytes([content[99] ^ 1]) + content[100:]
    with pytest.raises(DownloadError, match=rf"was damaged and is removed; its checksum is {algorithm}:\w+, not"):
        obtained(public_set(server, archive), tmp_path)
    assert folder_content(tmp_path) == {}
    server.files["/desk.tgz"] = content
    assert obtained(public_set(server, archive), tmp_path) == FILES


def test_a_download_that_brings_nothing_leaves_no_folders(server: FileServer, tmp_path: Path) -> None:
    missing = public_set(server, RemoteFile(server.url("/gone.tgz")))
    with pytest.raises(DownloadError, match="cannot be had"):
        obtained(missing, tmp_path / "data" / "deep")
    assert not any(tmp_path.iterdir()), "what was made for it is taken back"
    (tmp_path / "data").mkdir()
    with pytest.raises(DownloadError, match="cannot be had"):
        obtained(missing, tmp_path / "data" / "deep")
    assert [path.name for path in tmp_path.rglob("*")] == ["data"], "what was there before stays"


def test_what_has_come_of_a_download_keeps_its_folder(server: FileServer, tmp_path: Path) -> None:
    server.files["/half.tgz"] = server.files["/desk.tgz"]
    both = public_set(server, RemoteFile(server.url("/half.tgz")), RemoteFile(server.url("/gone.tgz")))
    with pytest.raises(DownloadError, match="cannot be had"):
        obtained(both, tmp_path)
    assert (tmp_path / "test/half.tgz").read_bytes() == server.files["/desk.tgz"]


def test_without_one_the_first_download_is_the_measure(server: FileServer, tmp_path: Path) -> None:
    obtained(public_set(server), tmp_path)
    record = tmp_path / "test/desk.tgz.sha256"
    assert record.read_text() == f"{hashlib.sha256(server.files['/desk.tgz']).hexdigest()}  desk.tgz\n"
    server.files["/desk.tgz"] = tar_gz({"desk/rgb.txt": b"new"})
    with pytest.raises(DownloadError, match=r"it was another one last time .*delete .*sha256 to accept it"):
        obtained(public_set(server), tmp_path, overwrite=True)
    assert folder_content(tmp_path / "test/desk").keys() == {*FILES, MARKER}, "what was there is still there"
    record.unlink()
    assert obtained(public_set(server), tmp_path, overwrite=True) == {"rgb.txt": b"new"}


@pytest.mark.parametrize("there", ["folder", "file", "broken link"])
def test_what_is_not_ours_is_left_alone(there: str, server: FileServer, tmp_path: Path) -> None:
    target = tmp_path / "test/desk"
    target.parent.mkdir()
    {"folder": target.mkdir, "file": target.touch, "broken link": lambda: target.symlink_to("/no/such")}[there]()
    with pytest.raises(DownloadError, match="was not made by this command"):
        download_recording(public_set(server), "desk", tmp_path, lambda *counts: None, overwrite=True)
    assert server.ranges == [] and (target.exists() or target.is_symlink())


@pytest.mark.parametrize("content", [tar_gz({"desk/../../../evil": b"1"}), tar_gz(FILES)[:-900], zipped({"a": b""})])
def test_a_bad_archive_leaves_nothing(content: bytes, server: FileServer, tmp_path: Path) -> None:
    server.files["/desk.tgz"] = content
    with pytest.raises(DownloadError, match=r"desk.tgz is removed, run it again"):
        obtained(public_set(server), tmp_path)
    assert list(folder_content(tmp_path)) == ["test/desk.tgz.sha256"]
    assert [path.name for path in (tmp_path / "test").iterdir()] == ["desk.tgz.sha256"]


def test_too_many_bytes_or_files_are_refused(server: FileServer, tmp_path: Path) -> None:
    server.files["/desk.tgz"] = tar_gz({f"desk/{i}": b"" for i in range(30)})
    with pytest.raises(DownloadError, match="more files than such a recording can have"):
        obtained(public_set(server), tmp_path)
    server.files["/bomb.tgz"] = tar_gz({"desk/zeros": bytes(2**22)})
    with pytest.raises(DownloadError, match="more bytes than such a recording can have"):
        obtained(public_set(server, RemoteFile(server.url("/bomb.tgz"))), tmp_path)


def test_an_unexpected_layout_is_refused(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match="does not hold room0; its layout has changed"):
        obtained(public_set(server, start="room0"), tmp_path)
    assert not (tmp_path / "test/desk").exists()


def test_another_file_than_announced_is_refused_early(server: FileServer, tmp_path: Path) -> None:
    size = len(server.files["/desk.tgz"])
    for archive, says in (
        (RemoteFile(server.url("/desk.tgz"), 9 * size), "not about"),
        (RemoteFile(server.url("/desk.tgz"), size + 1, "sha256:00"), f"has {size:,} bytes, not {size + 1:,}"),
    ):
        with pytest.raises(DownloadError, match=says):
            obtained(public_set(server, archive), tmp_path)
    with pytest.raises(DownloadError, match="too many to be what was asked for"):
        obtained(replace(public_set(server), max_bytes=100), tmp_path)
    assert folder_content(tmp_path) == {}


def test_room_is_looked_for_first(server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Disk:
        free = 2 * len(server.files["/desk.tgz"])

    monkeypatch.setattr("shutil.disk_usage", lambda folder: Disk)
    with pytest.raises(DownloadError, match=r"not enough room in .*needed, .* free; make room, or give --out"):
        obtained(public_set(server), tmp_path)
    assert folder_content(tmp_path) == {}


def test_ctrl_c_while_unpacking_leaves_the_archive_only(server: FileServer, tmp_path: Path) -> None:
    def interrupt(title: str, done: int, total: int) -> None:
        if title.startswith("unpack"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download_recording(public_set(server), "desk", tmp_path, interrupt)
    assert {path.name for path in (tmp_path / "test").iterdir()} == {"desk.tgz", "desk.tgz.sha256"}
    requests = list(server.ranges)
    assert obtained(public_set(server), tmp_path) == FILES
    assert server.ranges == requests


def test_a_broken_download_goes_on_next_time(server: FileServer, tmp_path: Path) -> None:
    server.acts = [acts.drop_after(80), acts.status(503), acts.status(503)]
    with pytest.raises(DownloadError, match="80 bytes are kept"):
        obtained(public_set(server), tmp_path)
    assert obtained(public_set(server), tmp_path) == FILES
    assert server.ranges[-1] == "bytes=80-"


def test_names_are_found_as_people_write_them() -> None:
    for name in ("fr1/desk", "FR1/desk", "fr1_desk", "freiburg1_desk", "rgbd_dataset_freiburg1_desk", "fr1-desk"):
        assert find_recording("tum", name)[1] == "fr1/desk"
    assert find_recording("bonn", "rgbd_bonn_balloon2")[1] == "balloon2"
    assert find_recording("Replica") == (SETS["replica"], "")


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (("tumm", ""), "no data set 'tumm'; did you mean tum?"),
        (("kitchen", ""), "no data set 'kitchen'; there are 7scenes, bonn"),
        (("tum", "fr1/dsk"), "no recording 'fr1/dsk' in tum; did you mean fr1/desk"),
        (("7scenes", ""), "say which recording of 7scenes; there are chess, fire"),
        (("replica", "room0"), "replica comes whole, in one archive, not 'room0'"),
        (("scannet", "scene0000_00"), "ScanNet is given on request only: ask at http"),
        (("scannetpp", ""), "is given on request only: ask at https://scannetpp"),
    ],
)
def test_the_error_on_an_unknown_name_lists_the_known_ones(asked: tuple[str, str], says: str) -> None:
    with pytest.raises(DownloadError, match=re.escape(says)):
        find_recording(*asked)


def test_the_catalogue_is_listed() -> None:
    assert {line.split()[0] for line in describe_sets()} == set(SETS)
    lines = list(describe_recordings("tum"))
    assert any(re.fullmatch(r"fr1/desk +344\.0 MB", line) for line in lines), lines


@pytest.mark.parametrize("public", PUBLIC, ids=lambda public: public.title)
def test_the_catalogue_is_sound(public: PublicSet) -> None:
    """No two recordings share a folder or an archive's name, addresses are safe, sizes within the bounds."""
    folders = [recording.folder for recording in public.recordings.values()]
    archives = [archive for recording in public.recordings.values() for archive in recording.archives]
    assert len(set(folders)) == len(folders) and len({archive.name for archive in archives}) == len(archives)
    assert public.licence and public.page.startswith("http")
    for archive in archives:
        parts = urlsplit(archive.url)
        assert parts.scheme == "https" and parts.hostname and not parts.query
        assert (archive.size_bytes or 0) <= public.max_bytes
        assert re.fullmatch(r"(sha256:[0-9a-f]{64}|md5:[0-9a-f]{32})?", archive.checksum)
        assert archive.name.endswith((".tgz", ".tar.gz", ".zip")) or archive.into
    for folder in folders:
        assert re.fullmatch(r"[\w-]+", folder)
