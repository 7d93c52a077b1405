"""`nesy query`: every question on the command line, its graph, its mistakes, and Ctrl-C."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from nesy.cli import configuration
from nesy.cli.main import main
from tests.nesy.dbn.real import real_model

RULES = "forbidden(forward) :- now(wall_ahead).\nforbidden(forward) :- now(person_ahead).\npreferred(left) :- unseen.\n"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder with nothing but a configuration and an extracted model."""
    folder = tmp_path_factory.mktemp("runs") / "a run"
    base = real_model()
    base.dbn.save(folder / "dbn")
    base.codebook.save(folder / "dbn")
    configuration.save(configuration.PRESETS["smoke"], folder / "config.json", {})
    (folder / "rules.lp").write_text(RULES)
    (folder / "impossible.lp").write_text("impossible(A,F,X,V) :- row(A,F,X,V,W), W < 20000.\n")
    (folder / "all.lp").write_text("forbidden(A) :- action(A).\n")
    (folder / "endless.lp").write_text("n(0). n(X+1) :- n(X).\n")
    return folder


def ask(run, capsys, *question):
    assert main(["query", "--run", str(run), *question, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("question", "words"),
    [
        (["--means", "X0=2"], "it holds"),
        (["--predicate", "wall_ahead"], "wall_ahead holds in"),
        (["--when", "wall_ahead"], "held-out precision"),
        (["--when", "0=2"], "held-out precision"),
        (["--changes", "forward"], "'forward' changes"),
        (["--verify", "forward", "--premise", "X0=2, X0=3"], "Proved over all 8^8 codes"),
        (["--verify", "forward", "--premise", "X0=2", "--conclusion", "X0=2"], "Not so"),
        (["--plan", "wall_ahead", "--start", "3"], "lead to [wall_ahead]"),
        (["--trajectory", "wall_ahead", "--start", "3"], "lead to [wall_ahead]"),
        (["--reach", "wall_ahead", "--start", "3"], "[wall_ahead] can hold after"),
        (["--reach", "", "--max-steps", "2"], "codes can be reached"),
        (["--after", "left", "forward", "--start", "3"], "must hold"),
        (["--explain", "forward", "--start", "3"], "because of"),
        (["--knows", "wall_ahead", "--views", "1", "2", "3"], "wall_ahead:"),
        (["--knows", "wall_ahead", "goal_visible", "--start", "3", "--person", "0,2,1"], "the person"),
        (["--vocabulary"], "cooccurs"),
    ],
)
def test_every_question_has_an_answer(run, capsys, question, words):
    assert words in ask(run, capsys, *question)["text"]


def test_a_shield_names_the_rules(run, capsys):
    base = real_model()
    ahead = int(base.codebook.predicate("wall_ahead").argmax())
    found = ask(run, capsys, "--shield", "--rules", str(run / "rules.lp"), "--start", str(ahead))
    (row,) = found["rows"]
    assert row["allowed"] == ["left", "right", "stay"] and row["preferred"] == ["left"]
    assert row["because"] == {"forward": [f"{run / 'rules.lp'}:1:1"]}
    free = int((~base.codebook.predicate("wall_ahead")).argmax())
    options = ["--start", str(free), "--person", "0,1,3"]
    (row,) = ask(run, capsys, "--shield", "--rules", str(run / "rules.lp"), *options)["rows"]
    assert row["because"] == {"forward": [f"{run / 'rules.lp'}:2:1"]} and row["preferred"] == []


def test_rules_act_on_the_table(run, capsys, tmp_path):
    from nesy.asp import KnowledgeBase

    found = ask(run, capsys, "--constrain", "--rules", str(run / "impossible.lp"), "--out", str(tmp_path / "left"))
    left = KnowledgeBase.from_folder(tmp_path / "left")
    removed = (real_model().dbn.probabilities > 0) & (left.dbn.probabilities == 0)
    assert found["entries"] == removed.sum() > 0
    assert (
        main(["query", "--run", str(run), "--constrain", "--rules", str(run / "impossible.lp"), "--out", "/tmp"]) == 2
    )


def test_rules_act_on_plans(run, capsys):
    (row,) = ask(run, capsys, "--plan", "wall_ahead", "--start", "3")["rows"]
    ban = run / "ban.lp"
    ban.write_text(f":- do({row['actions'][0]},T).\n")
    (other,) = ask(run, capsys, "--plan", "wall_ahead", "--start", "3", "--rules", str(ban))["rows"]
    assert other["actions"] is None or row["actions"][0] not in other["actions"]


@pytest.mark.parametrize("ending", ["svg", "dot", "graphml", "json"])
def test_what_supports_an_answer_is_a_graph(run, capsys, tmp_path, ending):
    path = tmp_path / f"graph.{ending}"
    ask(run, capsys, "--explain", "forward", "--start", "3", "--graph", str(path))
    text = path.read_text()
    assert "X0' =" in text.replace("&#x27;", "'").replace("&apos;", "'") or ending == "svg"
    assert text.lstrip().startswith({"svg": "<?xml", "dot": "digraph", "graphml": "<?xml", "json": "{"}[ending])


@pytest.mark.parametrize(
    ("question", "words"),
    [
        (["--shield"], "--shield needs --rules"),
        (["--constrain"], "--constrain needs --rules"),
        (["--knows", "wall_ahead", "--person", "9,9,9"], "side,ahead,heading"),
        (["--means", "X0"], "FACTOR=VALUE"),
        (["--start", "99999", "--explain", "left"], "no such view"),
        (["--explain", "left", "--graph", "x.txt"], ".svg, .png"),
        (["--why", "nobody"], "no agent 'nobody'"),
        (["--why", "dqn"], "world_model"),
    ],
)
def test_mistakes_are_one_clear_line(run, capsys, question, words):
    assert main(["query", "--run", str(run), *question]) == 2
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error


def test_hostile_text_is_one_line_and_a_byte_order_mark_is_read(run, capsys, tmp_path):
    bad, number, marked = (tmp_path / f"{name}.lp" for name in ("bad", "number", "marked"))
    bad.write_text("forbidden(forward) :- now(wall_ahead),\u00a0unseen.", encoding="utf-8")
    number.write_text("a. \nforbidden(2147483648).", encoding="utf-8")
    marked.write_bytes(b"\xef\xbb\xbfq(1).\n#show q/1.\n")
    for path, place in ((bad, "1:39: U+00A0"), (number, "2:11: 2147483648 is too large")):
        for question in (["--program", str(path)], ["--program", str(marked), "--rules", str(path)]):
            assert main(["query", "--run", str(run), *question]) == 2
            error = capsys.readouterr().err
            assert f"{path}:{place}" in error and error.count("\n") == 1
        for question in ("--shield", "--constrain", "--plan=wall_ahead"):
            assert main(["query", "--run", str(run), question, "--rules", str(path)]) == 2
            error = capsys.readouterr().err
            assert f"{path}:{place}" in error and error.count("\n") == 1
    assert ask(run, capsys, "--program", str(marked))["models"] == [["q(1)"]]


def test_models_without_an_action_stay(run, capsys, tmp_path):
    from dataclasses import replace

    base = real_model()
    replace(base.dbn, action_names=("Left", "Right", "go on", "Wait")).save(tmp_path / "dbn")
    base.codebook.save(tmp_path / "dbn")
    configuration.save(configuration.PRESETS["smoke"], tmp_path / "config.json", {})
    rules = tmp_path / "rules.lp"
    rules.write_text('forbidden(A) :- action(A). preferred("go on").')
    asked = ["--shield", "--rules", str(rules), "--start", "0"]
    found = ask(tmp_path, capsys, *asked)
    assert found["rows"][0]["allowed"] == ["Left", "Right", "go on", "Wait"] and "fallback 'all'" in found["text"]
    assert "fallback 'stay'" in ask(run, capsys, *asked[:1], "--rules", str(run / "all.lp"), "--start", "0")["text"]
    assert main(["query", "--run", str(tmp_path), *asked, "--fallback", "stay"]) == 2
    assert "needs an action 'stay'" in capsys.readouterr().err
    facts = ask(tmp_path, capsys, "--vocabulary")["facts"]
    assert facts["action(A)"] == 'A is an action: "Left", "Right", "go on", "Wait"'
    assert "empty, wall, goal, unseen (viewer at (2,4)" in facts["cell(I,X,Y,T)"]


def test_ctrl_c_ends_a_query_and_its_process(run):
    command = [sys.executable, "-m", "nesy.cli.main", "query", "--run", str(run), "--time-limit", "60"]
    process = subprocess.Popen(
        [*command, "--program", str(run / "endless.lp")],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a shell's background jobs ignore SIGINT, and so would this
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    children: list[int] = []
    deadline = time.monotonic() + 60
    while not children and time.monotonic() < deadline:
        time.sleep(0.05)
        listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True)
        children = [int(pid) for pid in listed.stdout.split()]
    assert children
    time.sleep(0.3)
    os.kill(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert process.returncode not in (0, 2) and "Traceback" not in error
    for child in children:
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)
