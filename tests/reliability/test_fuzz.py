"""Damaged files of every kind: a clear line or a good load, never a traceback, a hang or code that runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from domains.core import DomainError
from nesy.errors import UserError
from scripts.fuzz_loaders import fuzz, good_files, loaders


def test_loaders_take_mutated_files_well(tiny_run: Path) -> None:
    failures, tally = fuzz(tiny_run, count=260, seed=20)
    assert failures == []
    for loader in loaders():
        assert tally[loader.name] == 20
    # mutations do break files: else nothing is tested
    assert sum(tally[f"{loader.name}: loaded"] for loader in loaders()) < 200


@pytest.fixture(scope="module")
def files(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    good_files(tiny_run, folder)
    return folder


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """Some stretches replaced, removed or inserted, and the end perhaps cut off; hypothesis shrinks what it finds."""
    for _ in range(draw(st.integers(1, 4))):
        begin = draw(st.integers(0, len(content)))
        end = min(len(content), begin + draw(st.sampled_from((0, 1, 2, 8, 64, 4096))))
        content = content[:begin] + draw(st.binary(max_size=12)) + content[end:]
    return content[: draw(st.integers(0, len(content)))] if draw(st.booleans()) else content


@pytest.mark.parametrize("name", [loader.name for loader in loaders()])
def test_loaders_take_damaged_bytes_well(name: str, files: Path) -> None:
    (loader,) = (one for one in loaders() if one.name == name)
    loader.load(files)

    @settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def check(data: st.DataObject) -> None:
        path = files / data.draw(st.sampled_from(loader.files))
        content = path.read_bytes()
        path.write_bytes(data.draw(damaged(content)))
        try:
            loader.load(files)
        except (UserError, DomainError) as error:
            assert str(error).strip() and len(str(error)) <= 2000
        finally:
            path.write_bytes(content)

    check()
