"""Keep inputs that once failed, as small archives of what differs from a valid sample."""

import json
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from fuzz_mutations import Files
from fuzz_samples import Sample

CORPUS = Path(__file__).parent / "corpus"
CASE = "case.json"


def save(path: Path, sample: Sample, files: Files, command: Sequence[str]) -> None:
    """Write an input: the files that differ from the sample, and the names of those that are missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    missing = sorted(set(sample.files) - set(files))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(CASE, json.dumps({"sample": sample.name, "command": list(command), "missing": missing}))
        for name, content in files.items():
            if sample.files.get(name) != content:
                archive.writestr(f"files/{name}", content)


def read(path: Path, samples: dict[str, Sample]) -> tuple[Sample, Files, list[str]]:
    """Return the sample, all files of the input, and the command."""
    with zipfile.ZipFile(path) as archive:
        case = json.loads(archive.read(CASE))
        sample = samples[case["sample"]]
        files = {name: content for name, content in sample.files.items() if name not in case["missing"]}
        names = [name for name in archive.namelist() if name != CASE]
        return sample, files | {n.removeprefix("files/"): archive.read(n) for n in names}, case["command"]


def cases() -> Iterator[Path]:
    """Yield the archives of past failures."""
    yield from sorted(CORPUS.glob("*.zip"))
