"""The page on adding a domain, run as printed; and the checker, which must find what is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from domains import DomainError, check_domain, load_domain, register_domain
from domains.core import _REGISTRY


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
    blocks = re.findall(r"```python\n(.*?)```", Path("docs/new-domain.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "corridor.py").write_text("\n".join(blocks[:3]), encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert load_domain("corridor").spec.name == "corridor"
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
