"""The commands of docs/formats.md do what they say, on a small run."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nesy.cli import configuration
from nesy.cli.main import main
from nesy.dbn.codebook import Codebook
from nesy.run_folder import RunFolder, write_json
from tests.nesy.dbn.models import random_dbn
from tests.nesy.dbn.steps import with_steps

DOCS = Path(__file__).parents[3] / "docs" / "formats.md"
PYTHON = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
COMMANDS = [
    line for block in re.findall(r"```sh\n(.*?)```", DOCS.read_text(), re.DOTALL) for line in block.splitlines() if line
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = RunFolder(tmp_path_factory.mktemp("formats") / "run")
    rng = np.random.default_rng(0)
    dbn = random_dbn(rng, num_factors=8, num_values=4, num_actions=4, max_parents=1)
    codes = rng.integers(0, 4, size=(12, 8)).astype(np.uint8)
    dbn = replace(dbn, action_names=("left", "right", "forward", "stay"), tables={"codes": np.unique(codes, axis=0)})
    with_steps(dbn, rng).save(folder.dbn)
    views = rng.integers(0, 3, size=(12, 5, 5)).astype(np.uint8)
    Codebook.build(views, codes, np.ones(12), None).save(folder.dbn)
    configuration.save(configuration.PRESETS["smoke"], folder.config, {})
    write_json(folder.experience / "complete.json", {"rows": 1})
    folder.world_model.mkdir()
    (folder.world_model / "model.safetensors").touch()
    folder.update_summary(dbn={"rows": len(dbn.probabilities), "fidelity": {}}, perspective={}, semantics={})
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_page(command, run, tmp_path, capsys):
    arguments = shlex.split(command.replace("RUN", str(run.path)).replace("OUT", str(tmp_path)))
    assert arguments[0] == "nesy"
    assert main(arguments[1:]) == 0, capsys.readouterr().err
    if "--to" in arguments:
        assert Path(arguments[arguments.index("--to") + 1]).exists()
    else:
        assert ("met in experience" if "--step-table" in arguments else "leaves") in capsys.readouterr().out


def test_mistakes_in_options_of_a_part_are_one_line(run, tmp_path, capsys):
    for options, said in (
        ("--goal X9=1", "no factor 'X9'"),
        ("--goal X1=9", "FACTOR=VALUE"),
        ("--cone Y", "no factor 'Y'"),
        ("--start view:99", "views are 0 to 11"),
        ("--start 1,2", "8 values"),
        ("--plan jump", "no action 'jump'"),
        ("--plan forward", "no place for the option 'plan'"),
    ):
        before = sorted(tmp_path.iterdir())
        assert main(["extract", "--run", str(run.path), "--to", str(tmp_path / "m.csv"), *options.split()]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1
        assert sorted(tmp_path.iterdir()) == before


def test_formats_of_the_page_are_all_formats():
    from nesy.formats import FORMATS

    named = set(re.findall(r"`([a-z]+)`", "".join(re.findall(r"^\| `.*?\|", DOCS.read_text(), re.MULTILINE))))
    assert set(FORMATS) <= named


def test_python_of_the_page(run):
    names = {}
    for block in PYTHON:
        exec(compile(block.replace("runs/demo", str(run.path)), DOCS.name, "exec"), names)
    assert names["table"].look_up(names["codes"], names["actions"], names["next_codes"]).shape == (1, 1, 2)
