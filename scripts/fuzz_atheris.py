"""Coverage-guided fuzzing of every loader with atheris (libFuzzer), where it installs: pip install 'nesy[fuzz]'.

    .venv/bin/python scripts/fuzz_atheris.py --run runs/demo --runs 2000

Each loader of scripts/fuzz_loaders.py gets a process of its own with the project's code instrumented. Inputs are one
byte that chooses the file and the file's content; half of the mutations are libFuzzer's, half those of
scripts/mutations.py, which know JSON, NumPy archives, Parquet and safetensors. As there, a loader may return or raise
`UserError`; anything else counts against it, as do more than 5 s, 1 GB more than it began with, and code that runs.
"""

from __future__ import annotations

import argparse
import re
import resource
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

MOST_BYTES = 8 << 20
"""Larger files are mutated by scripts/fuzz_loaders.py alone: libFuzzer would hardly get through them."""


def fuzz_one(name: str, run: Path, runs: int, seed: int, keep: Path) -> None:
    """Fuzz one loader in this process, which libFuzzer ends; its status says whether something was found."""
    import atheris

    with atheris.instrument_imports(include=["nesy", "planners", "domains"]):
        from scripts import fuzz_loaders
        from scripts.mutations import fit_checksum, mutate

        (loader,) = (one for one in fuzz_loaders.loaders() if one.name == name)
        from domains.core import DomainError
        from nesy.errors import UserError

    with tempfile.TemporaryDirectory() as scratch:
        root, corpus, canary = Path(scratch) / "files", Path(scratch) / "corpus", Path(scratch) / "canary"
        root.mkdir()
        corpus.mkdir()
        fuzz_loaders.good_files(run, root)
        loader.load(root)
        good = [root / file for file in loader.files]
        contents = [path.read_bytes() for path in good]
        chosen = [i for i, content in enumerate(contents) if len(content) < MOST_BYTES]
        for i in chosen:
            (corpus / str(i)).write_bytes(bytes([i]) + contents[i])

        def load(data: bytes) -> None:
            i = data[0] % len(good) if data else 0
            written = {good[i]: contents[i]}
            good[i].write_bytes(data[1:])
            if good[i].suffix == ".npz":
                fit_checksum(good[i], data[1:], written)
            try:
                loader.load(root)
            except (UserError, DomainError) as error:
                if len(str(error)) > 2000 or not str(error).strip():
                    raise AssertionError(f"a message of {len(str(error))} characters") from None
            finally:
                for path, content in written.items():
                    path.write_bytes(content)
            assert not canary.exists(), "code of the file was run"

        def mutated(data: bytes, most: int, number: int) -> bytes:
            rng = np.random.default_rng(number)
            i = data[0] % len(good) if data else 0
            if rng.random() < 0.5:
                return atheris.Mutate(data, most)
            try:
                _, content = mutate(good[i], data[1:], rng, canary)
            except Exception:  # it is no JSON, archive or table any more: only bytes can be changed
                return atheris.Mutate(data, most)
            return bytes([i]) + content[: most - 1]

        held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
        longest = max(len(contents[i]) for i in chosen) + 4096
        flags = [f"-runs={runs}", f"-seed={seed + 1}", f"-max_len={longest}", "-timeout=5", "-len_control=0",
                 f"-rss_limit_mb={held + 1024}", "-print_final_stats=1", f"-artifact_prefix={keep}/"]  # fmt: skip
        atheris.Setup([sys.argv[0], *flags, str(corpus)], load, custom_mutator=mutated)
        atheris.Fuzz()


def main() -> int:
    """Print one line per loader; the status is 1 if anything was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--run", type=Path, default=Path("runs/demo"), help="a finished run; a small one is faster")
    parser.add_argument("--runs", type=int, default=2000, help="inputs per loader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="one loader")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"), help="gets the inputs that found something")
    parser.add_argument("--here", action="store_true", help="fuzz --only in this process")
    options = parser.parse_args()
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("atheris is not installed; install it with: pip install 'nesy[fuzz]'", file=sys.stderr)
        return 2
    options.keep.mkdir(parents=True, exist_ok=True)
    if options.here:
        fuzz_one(options.only, options.run.resolve(), options.runs, options.seed, options.keep.resolve())
        return 0
    from scripts.fuzz_loaders import loaders

    found = 0
    for loader in loaders():
        if options.only not in ("", loader.name):
            continue
        command = [sys.executable, __file__, "--here", "--only", loader.name, "--runs", str(options.runs)]
        command += [
            "--run",
            str(options.run.resolve()),
            "--seed",
            str(options.seed),
            "--keep",
            str(options.keep.resolve()),
        ]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", cwd=ROOT)
        statistics = dict(re.findall(r"stat::(\w+):\s+(\d+)", done.stderr))
        covered = re.findall(r"cov: (\d+)", done.stderr) or ["0"]
        count = statistics.get("number_of_executed_units", "?")
        verdict = "nothing found" if done.returncode == 0 else "FOUND: " + _finding(done.stdout + done.stderr)
        print(f"{loader.name:16} {count:>7} inputs, {covered[-1]:>5} branches covered: {verdict}", flush=True)
        found += done.returncode != 0
    return int(found > 0)


def _finding(said: str) -> str:
    """The exception, and where in the project it came from."""
    lines = [line.strip() for line in said.splitlines()]
    exception = [after for line, after in pairwise(lines) if "Uncaught Python exception" in line]
    places = [line for line in lines if line.startswith('File "')]
    return " | ".join([*exception, *places[-2:]] or lines[-3:])[:1000]


if __name__ == "__main__":
    sys.exit(main())
