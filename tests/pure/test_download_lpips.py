"""`download lpips` against a local server, with files of random weights of the true shapes, then `find_lpips`."""

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import file_server as acts
from file_server import FileServer, serving
from lpips_weights import TRUNK_FILE, write_weights
from sigmasplat.errors import DownloadError
from sigmasplat.plugins.download import download_recording, fetch as fetching
from sigmasplat.plugins.download.catalogue import SETS, PublicSet, RemoteFile
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips, find_lpips


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(fetching, "ATTEMPTS", 2)
    monkeypatch.setattr(fetching, "WAIT_S", 0.001)
    with serving() as server:
        yield server


def served(server: FileServer, weights: Path) -> PublicSet:
    """Serve the files of AlexNet; return the set of the catalogue with their addresses, sizes and checksums.

    The checksums are as long as those of the catalogue: whole, or the start that is in the name of the file.
    """
    public = SETS["lpips"]
    assert isinstance(public, PublicSet)

    def local(file: RemoteFile) -> RemoteFile:
        name = file.url.rpartition("/")[2]
        content = (weights / name).read_bytes()
        server.files[f"/{name}"] = content
        algorithm, _, digest = file.checksum.partition(":")
        checksum = f"{algorithm}:{hashlib.new(algorithm, content).hexdigest()[: len(digest)]}"
        return replace(file, url=server.url(f"/{name}"), size_bytes=len(content), checksum=checksum)

    recording = public.recordings["alex"]
    archives = tuple(map(local, recording.archives))
    return replace(public, recordings={"alex": replace(recording, archives=archives)})


def download(public: PublicSet, out: Path) -> Path:
    """Download AlexNet; return the folder in which `eval` looks for it."""
    download_recording(public, "alex", out, lambda *counts: None)
    return out / public.folder


def assert_same_weights(found: Lpips, expected: Lpips) -> None:
    pairs = zip(found.features.parameters(), expected.features.parameters(), strict=True)
    assert all(torch.equal(x, y) for x, y in pairs)
    assert all(torch.equal(x, y) for x, y in zip(found.linear, expected.linear, strict=True))


def test_downloaded_weights_are_found_and_loaded(server: FileServer, tmp_path: Path) -> None:
    write_weights(tmp_path / "public")
    folder = download(served(server, tmp_path / "public"), tmp_path / "data")
    found, problem = find_lpips(folder)
    assert found is not None and not problem
    assert_same_weights(found, Lpips.load(tmp_path / "public"))


def test_a_broken_download_of_weights_is_resumed(server: FileServer, tmp_path: Path) -> None:
    write_weights(tmp_path / "public")
    public = served(server, tmp_path / "public")
    server.acts = [acts.whole, acts.drop_after(3_000_000), acts.status(503), acts.status(503)]
    with pytest.raises(DownloadError, match="3,000,000 bytes are kept"):
        download(public, tmp_path / "data")
    assert find_lpips(tmp_path / "data/lpips")[0] is None
    asked = len(server.ranges)
    found, _ = find_lpips(download(public, tmp_path / "data"))
    assert server.ranges[asked:] == ["bytes=3000000-"]
    assert found is not None
    assert_same_weights(found, Lpips.load(tmp_path / "public"))


def test_damaged_weights_are_removed_and_never_loaded(server: FileServer, tmp_path: Path) -> None:
    write_weights(tmp_path / "public")
    public, name = served(server, tmp_path / "public"), f"/{TRUNK_FILE}"
    good = server.files[name]
    server.files[name] = good[:5_000_000] + bytes([good[5_000_000] ^ 1]) + good[5_000_001:]
    with pytest.raises(DownloadError, match="was damaged and has been removed"):
        download(public, tmp_path / "data")
    found, problem = find_lpips(tmp_path / "data/lpips")
    assert found is None and "sigmasplat download lpips alex" in problem
    server.files[name] = good
    found, _ = find_lpips(download(public, tmp_path / "data"))
    assert found is not None
