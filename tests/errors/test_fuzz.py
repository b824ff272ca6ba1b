"""Commands on mutated files: each is refused in one line, or used without harm. Past failures stay repaired.

`benchmarks/fuzz.py` runs many more inputs.
"""

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

import fuzz_corpus
import fuzz_server
from fuzz_mutations import mutated
from fuzz_samples import Sample, samples

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
for module in ("cv2", "rosbags", "lzfse", "OpenEXR"):
    pytest.importorskip(module)

INPUTS, SEED = 80, 0


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Sample]]:
    fuzz_server.warm_up()
    yield {sample.name: sample for sample in samples(tmp_path_factory.mktemp("samples"))}


def failure(sample: Sample, files: dict[str, bytes], command: list[str], folder: Path) -> str:
    ending = fuzz_server.run_files(sample, files, command, folder)
    return f"{sample.name}: {ending}" if ending.kind in fuzz_server.FAILURES else ""


def test_mutated_inputs_are_refused_in_one_line_or_used(found: dict[str, Sample], tmp_path: Path) -> None:
    failures = []
    for number in range(INPUTS):
        rng = random.Random(f"{SEED}/{number}")
        sample = rng.choice(list(found.values()))
        command, files = rng.choice(sample.commands), mutated(sample.files, rng)
        failures.append(failure(sample, files, list(command), tmp_path / str(number)))
    assert not list(filter(None, failures))


@pytest.mark.parametrize("path", list(fuzz_corpus.cases()), ids=lambda path: path.stem)
def test_past_failures_stay_repaired(path: Path, found: dict[str, Sample], tmp_path: Path) -> None:
    sample, files, command = fuzz_corpus.read(path, found)
    assert not failure(sample, files, command, tmp_path / "case")
