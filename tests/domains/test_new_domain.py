"""The page on adding a domain, run as printed; and the checker, which must find what is wrong."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from domains import DomainError, check_domain, load_domain, register_domain
from domains.core import DomainSpec, completed, location_of
from domains.worlds import _REGISTRY

ROOT = Path(__file__).resolve().parents[2]


def _code() -> str:
    """The first three blocks of the page: environment, predicates, domain."""
    text = (ROOT / "docs/new-domain.md").read_text(encoding="utf-8")
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[:3])


@pytest.fixture(scope="module")
def page():
    text = Path("docs/new-domain.md").read_text(encoding="utf-8")
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        exec(compile(block, "docs/new-domain.md", "exec"), names)
    yield names
    _REGISTRY.pop("corridor", None)


def test_the_page_works_as_printed(page):
    assert page["report"].episodes > 10
    assert page["DOMAIN"].views("long").shape == (6, 5, 5)


def test_registered_domains_are_imported_when_asked_for(page, tmp_path, monkeypatch):
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "corridor.py").write_text(_code(), encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    register_domain("corridor", "my_package.corridor:DOMAIN")
    assert load_domain("corridor").spec.name == "corridor"
    assert location_of("corridor") == location_of(location_of("corridor")) == "my_package.corridor:DOMAIN"
    with pytest.raises(DomainError, match="package"):
        register_domain("other", "my_package.corridor")


def test_our_own_domain_passes():
    report = check_domain(load_domain(), num_envs=4, steps=60)
    assert report.episodes > 50


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda env: setattr(env, "counters", lambda: np.zeros((env.num_envs, 2))), "counters"),
        (lambda env: setattr(env, "_observe", lambda: {"view": np.zeros((env.num_envs, 5, 5))}), "configuration"),
        (lambda env: setattr(env, "relative_poses", lambda: np.ones((env.num_envs, 3), np.int16)), "relative_poses"),
        (lambda env: setattr(env, "expert_actions", lambda kind: np.full(env.num_envs, 7)), "expert"),
        (lambda env: setattr(env, "step", lambda actions: None), ""),
    ],
)
def test_the_checker_finds_what_is_wrong(page, break_it, message):
    class Broken(page["CorridorDomain"]):
        def make(self, *args, **keywords):
            env = super().make(*args, **keywords)
            break_it(env)
            return env

    with pytest.raises((DomainError, TypeError), match=message):
        check_domain(Broken(), steps=100)


def test_the_checker_wants_determinism_and_sound_predicates(page):
    class Random(page["CorridorDomain"]):
        def make(self, *args, **keywords):
            env = super().make(*args, **keywords)
            env.reset = lambda seed=None, options=None: (env._observe(), {})
            env.rng = np.random.default_rng()
            return env

    with pytest.raises(DomainError, match="same seed"):
        check_domain(Random(), steps=60)

    class Peeking(page["CorridorPredicates"]):
        def evaluate(self, views):
            return np.repeat(super().evaluate(views).any(axis=0)[None], len(views), axis=0)

    broken = page["CorridorDomain"]()
    broken.predicates = Peeking()
    with pytest.raises(DomainError, match="by itself"):
        check_domain(broken, steps=60)


def _changed(page, change):
    """A corridor whose steps are changed before they are returned."""

    class Changed(page["CorridorDomain"]):
        def make(self, *args, **keywords):
            env = super().make(*args, **keywords)
            step = env.step
            env.step = lambda actions: change(*step(actions))
            return env

    return Changed()


def _with(infos, **changes):
    return {**infos, **changes}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o, r, te, tr, i: (o, r.astype(np.float32), te, tr, i), "reward"),
        (lambda o, r, te, tr, i: (o, r * np.nan, te, tr, i), "finite"),
        (lambda o, r, te, tr, i: (o, r, te.astype(int), tr, i), "terminated"),
        (lambda o, r, te, tr, i: (o, r, te, tr, {k: v for k, v in i.items() if k != "distance"}), "distance"),
        (lambda o, r, te, tr, i: (o, r, te, tr, _with(i, _final_obs=~i["_final_obs"])), "_final_obs"),
        (lambda o, r, te, tr, i: (o, r, te, tr, _with(i, outcome=np.full(len(r), "won"))), "unknown outcomes"),
        (lambda o, r, te, tr, i: (o, r, te, tr, _with(i, outcome=np.full(len(r), "lost"))), "ended episodes"),
        (lambda o, r, te, tr, i: ({**o, "view": o["view"] + 9}, r, te, tr, i), "cell kinds"),
        (lambda o, r, te, tr, i: ({**o, "configuration": o["configuration"] + 500}, r, te, tr, i), "configuration"),
        (lambda o, r, te, tr, i: (o, r, te, tr, _with(i, final_obs={"view": 1 - o["view"] // 2})), "final_obs"),
    ],
)
def test_the_checker_finds_broken_steps(page, change, message):
    with pytest.raises(DomainError, match=message):
        check_domain(_changed(page, change), steps=60)


def test_the_checker_wants_bad_input_refused_and_names_that_can_be_used(page):
    class Lenient(page["CorridorDomain"]):
        def make(self, task, num_envs, variant="short", **keywords):
            return super().make("following", num_envs, variant if variant in ("short", "long") else "short", **keywords)

    with pytest.raises(DomainError, match="unknown task must raise"):
        check_domain(Lenient(), steps=100)

    class Unnamed(page["CorridorPredicates"]):
        names = ("Goal",)

    broken = page["CorridorDomain"]()
    broken.predicates = Unnamed()
    with pytest.raises(DomainError, match="ASP constant"):
        check_domain(broken, steps=100)


def _changed_spec(page, **changes):
    domain = page["CorridorDomain"]()
    domain.spec = DomainSpec(**{"name": "corridor", "variants": ("short", "long"), "tasks": ("following",), **changes})
    return domain


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "no name"}, "identifier"),
        ({"variants": ()}, "spec.variants"),
        ({"variants": ("short", "short")}, "twice"),
        ({"tasks": ("walking",)}, "spec.tasks must be of crossing, following"),
        ({"action_names": ("go", "Go", "stay")}, "ASP constant"),
        ({"action_names": ("north", "south", "east", "west")}, "first actions must be left, right, forward"),
        ({"action_names": ("left", "right", "forward")}, "transitions.*actions must be in 0..2"),
        ({"cell_kinds": ("empty", "wall", "goal", "unseen", "lava")}, "4 kinds"),
        ({"outcomes": ("", "won")}, "spec.outcomes"),
        ({"tasks": ("crossing", "following")}, "nobody is there, so configuration must be 0"),
    ],
)
def test_the_checker_reads_the_spec(page, changes, message):
    with pytest.raises(DomainError, match=message):
        check_domain(_changed_spec(page, **changes), steps=60)


@pytest.mark.parametrize(
    ("name", "member", "message"),
    [
        ("views", lambda self, variant="short": np.zeros((1, 5, 5), np.uint8), "views.. failed .TypeError"),
        ("views", lambda self, variant="short", task="": np.zeros((1, 5, 5)), "views.. must be uint8"),
        ("maps", lambda self, variant="short": (np.zeros((2, 3, 3)), np.ones(2)), "add up to 1"),
        ("maps", lambda self, variant="short": np.zeros((2, 3, 3)), "must give maps"),
        ("transitions", lambda self, variant="short", task="": (np.zeros(1),) * 3, "four arrays"),
        ("transitions", lambda self, *_: (*[np.zeros(1, np.int64)] * 3, np.zeros((1, 5, 5), np.uint8)), "view"),
        ("episode_metrics", lambda self, steps, variant="short": {"return": np.zeros(3)}, "episode_metrics"),
        ("belief_metrics", lambda self, *_: {"kl": np.zeros(2)}, "belief_metrics"),
        ("last_seen_follower", lambda self, num_envs, variant="short": None or object(), "last_seen_follower"),
        ("make", lambda self, task, num_envs, variant="short", seed=None: None, "make|BatchedEnvironment"),
    ],
)
def test_the_checker_calls_what_the_pipeline_calls(page, name, member, message):
    changed = type("Changed", (page["CorridorDomain"],), {name: member})
    with pytest.raises(DomainError, match=message):
        check_domain(changed(), steps=60)


@pytest.mark.parametrize(
    ("name", "member", "message"),
    [
        ("states", lambda self: [{"grid": np.zeros((3, 3), np.uint8)}] * self.num_envs, "must have 'agent'"),
        ("states", lambda self: [], "one state per environment"),
        ("map_ids", lambda self: self.person.copy(), "stay within an episode|same map"),
        ("relative_poses", None, "relative_poses"),
        ("expert_actions", lambda self, kind: {"goal": np.zeros(self.num_envs, np.int64)}[kind], "KeyError"),
        ("person_views", lambda self: self._look(self.person) + 9, "person_views"),
    ],
)
def test_the_checker_asks_environments_for_everything(page, name, member, message):
    changed = type("Changed", (page["Corridor"],), {name: member})

    class Domain(page["CorridorDomain"]):
        def make(self, task, num_envs, variant="short", seed=None, maps=None, cycle=False, **parameters):
            if task != "following" or variant not in ("short", "long"):
                raise DomainError("unknown")
            env = changed(num_envs, 6)
            env.reset(seed=seed)
            return env

    with pytest.raises(DomainError, match=message):
        check_domain(Domain(), steps=60)


def test_what_may_be_left_out_is_filled_in(page):
    class Alone(page["Corridor"]):
        """Nobody else: no person is mentioned anywhere."""

        relative_poses = person_views = person_actions = None

        def step(self, actions):
            if np.asarray(actions).shape != (self.num_envs,) or not np.isin(actions, range(4)).all():
                raise DomainError("wrong actions")
            self.robot += (np.asarray(actions) == 2) & (self.robot < self.length - 1)
            self.time += 1
            there, late = self.robot == self.length - 1, self.time >= 40
            code = np.where(there, 2, np.where(late, 5, 0))
            infos = {
                "outcome": np.array(page["OUTCOMES"])[code],
                "outcome_code": code.astype(np.int8),
                "final_obs": {"view": self._look(self.robot)},
                "_final_obs": code > 0,
            }
            self._begin(code > 0)
            return {"view": self._look(self.robot)}, 1.0 * there, there, late & ~there, infos

        def _observe(self):
            return {"view": self._look(self.robot)}

        def states(self):
            return [{"grid": np.zeros((self.length, 3), np.uint8), "agent": (int(r), 1, 0)} for r in self.robot]

    class Minimal:
        spec = DomainSpec(name="hall", variants=("only",), tasks=("crossing",), action_names=("a", "b", "c", "d"))
        predicates = page["CorridorPredicates"]()

        def make(self, task, num_envs, variant="only", seed=None, maps=None, cycle=False):
            if task != "crossing" or variant != "only":
                raise DomainError("unknown")
            env = Alone(num_envs, 6)
            env.reset(seed=seed)
            return env

    report = check_domain(Minimal(), steps=80)
    assert report.outcomes["agent_at_goal"] > 0
    assert "optimum" in report.left_out
    whole = completed(Minimal())
    assert whole is completed(whole)
    with pytest.raises(DomainError, match="world 'hall': it has no exact optimum"):
        whole.optimum("only")
    env = whole.make("crossing", 3)
    assert (env.person_views() == 3).all()
    assert env.reset(seed=0)[0]["configuration"].tolist() == [0, 0, 0]
    assert env.step(np.zeros(3, np.int64))[4]["visible"].tolist() == [False] * 3


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("nowhere:DOMAIN", "", "there is no module 'nowhere', neither installed nor in"),
        ("world_a:DOMAIN", "import nothing_like_it", "importing world_a failed: No module named 'nothing_like_it'"),
        ("world_b:DOMAIN", "def (", "importing world_b failed .SyntaxError"),
        ("world_c:DOMAIN", "1 / 0", "importing world_c failed .ZeroDivisionError"),
        ("world_d:DOMAIN", "raise SystemExit('bye')", "importing world_d failed .SystemExit"),
        ("world_e:DOMAIN", "", "world_e.py has no attribute 'DOMAIN'"),
        ("world_f:DOMAIN", "DOMAIN = 3", "no domain, it has no spec"),
        ("world_g:DOMAIN", "class DOMAIN: pass", "is a class"),
        ("a/b.py:DOMAIN", "", "unknown domain 'a/b.py:DOMAIN'"),
        ("corridors", "", "unknown domain 'corridors'"),
        ("world_h:", "", "unknown domain"),
    ],
)
def test_what_is_no_world_is_said_in_one_line(name, text, message, tmp_path, monkeypatch):
    (tmp_path / f"{name.split(':')[0].replace('/', '_')}.py").write_text(text)
    if name.startswith("nowhere"):
        (tmp_path / "nowhere.py").unlink()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(DomainError, match=message) as error:
        load_domain(name)
    assert "\n" not in str(error.value)


def _nesy(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "nesy", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=900)


SMALL = ("--collect.following-episodes", "60", "--compare.episodes", "6", "--compare.dqn.episodes", "10",
         "--train.epochs", "1", "--compare.influences", "perspective-shift")  # fmt: skip


def test_the_page_s_world_goes_through_all_steps_in_worker_processes(tmp_path):
    (tmp_path / "corridor.py").write_text(_code(), encoding="utf-8")
    agents = ("dqn", "pomdp", "greedy-follower", "greedy-last-seen", "random", "optimum")
    done = _nesy(tmp_path, "run", "--world", "corridor:DOMAIN", "--preset", "smoke", "--run", "mine", *SMALL,
                 "--compare.agents", *agents)  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert "world 'corridor' has no task 'crossing': its episodes are left out" in done.stderr
    assert "optimum / short left out: world 'corridor': it has no exact optimum" in done.stdout
    assert "greedy-last-seen / short left out" in done.stdout
    config = json.loads((tmp_path / "mine/config.json").read_text())
    assert (config["domain"], config["variant"]) == ("corridor:DOMAIN", "short")
    records = json.loads((tmp_path / "mine/summary.json").read_text())["comparison"]
    assert [record["agent"] for record in records] == ["dqn", "pomdp", "greedy-follower", "random"]
    page = (tmp_path / "mine/report.html").read_text()
    assert "World corridor:DOMAIN, variant short" in page
    assert "it has no exact optimum" in page
    assert all(
        episode["reproduced"]
        for episode in json.loads((tmp_path / "mine/results/replays.json").read_text())["episodes"]
    )
    # the run knows its world: nothing is done again, and another preset does not change it
    again = _nesy(tmp_path, "run", "--run", "mine")
    assert again.returncode == 0, again.stderr
    other = _nesy(tmp_path, "run", "--run", "mine", "--world", "person_following")
    assert other.returncode == 2
    assert "world: corridor:DOMAIN, now person_following" in other.stderr
    healthy = _nesy(tmp_path, "doctor", "--world", "corridor:DOMAIN", "--run", "mine")
    assert healthy.returncode == 0, healthy.stdout + healthy.stderr
    assert "nesy run there: goes through; agents compared: dqn, pomdp, greedy-follower, random" in healthy.stdout
    away = _nesy(tmp_path / "mine", "compare", "--run", ".")
    assert away.returncode == 2
    assert away.stderr.count("\n") == 1
    assert "there is no module 'corridor'" in away.stderr
