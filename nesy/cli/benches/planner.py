"""Tree search, simulations per second beside pomdp-py's POUCT, and the time of one decision.

The same models, depth, budget and kind of simulation on both sides, one core. A random factored model (8 factors of
8 values, 3 parents each, one factor seen): every simulation goes down to depth 20, beyond the tree by random actions.
The tiger problem: simulations end at a new node, which is worth nothing. A decision in person following is timed
where the run folder holds a planner's tables, at the default budget.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from nesy.cli.benches.measuring import Row, Settings, ranked, rate

NEEDS: tuple[str, ...] = ()
_FACTORS, _VALUES, _PARENTS, _ACTIONS, _DEPTH = 8, 8, 3, 4, 20
_BUDGET = 2000  # simulations per decision


def measure(settings: Settings) -> list[Row]:
    """Simulations per second; milliseconds per decision."""
    rows = _factored(settings) + _tiger(settings)
    if (settings.run.ialm / "model.json").exists():
        rows += _decision(settings)
    return rows


def _factored(settings: Settings) -> list[Row]:
    from nesy.dbn.inference.kernels import packed
    from nesy.dbn.model import TwoSliceDBN
    from planners.search.code_sampling import sampler
    from planners.search.random_bits import stream
    from planners.search.tree import allocate, clear
    from planners.search.walk import walks
    from planners.search.walked_models import FactoredModel

    rng = np.random.default_rng(settings.seed)
    parents = [[tuple(rng.choice(_FACTORS, _PARENTS, replace=False)) for _ in range(_FACTORS)] for _ in range(_ACTIONS)]
    tables = [
        [rng.dirichlet(np.full(_VALUES, 0.3), _VALUES**_PARENTS) for _ in range(_FACTORS)] for _ in range(_ACTIONS)
    ]
    reward = np.zeros((_FACTORS, _VALUES))
    reward[0] = rng.normal(size=_VALUES)
    model = FactoredModel.of(sampler(packed(TwoSliceDBN.from_tables(tables, parents))), reward, np.array([1]))
    belief = rng.integers(0, _VALUES, (500, _FACTORS)).astype(np.int16)
    tree, bits = allocate(_BUDGET + 2, _ACTIONS), stream(rng)
    depths: dict[str, float] = {}

    def ours() -> int:
        clear(tree)
        info = walks(
            model, belief, tree, _BUDGET, 0.0, _DEPTH, 0.95, 1.0, False, np.ones(_ACTIONS, np.bool_), bits, True
        )
        depths["ours"] = info["mean_depth"]
        return int(info["simulations"])

    theirs = _pomdp_py_on_factors(model, belief, rng)
    name = f"{_FACTORS} x {_VALUES} factored model, {_PARENTS} parents, depth {_DEPTH}"
    peer = f"{name}: pomdp-py POUCT"
    rates = {
        f"{name}: planners.search.walk": rate(ours, settings.seconds),
        peer: rate(theirs, settings.seconds),
    }
    rows = ranked("simulations/s", peer, rates)
    return [*rows, Row(f"{name}: mean length of a walk", depths["ours"], "steps", peer, 0.0)]


def _pomdp_py_on_factors(model: Any, belief: np.ndarray, rng: np.random.Generator) -> Any:
    """A function that runs pomdp-py's POUCT on the same model and says how many simulations it was."""
    import pomdp_py

    from planners.search.code_sampling import next_code
    from planners.search.random_bits import stream, uniform

    actions = [pomdp_py.SimpleAction(str(a)) for a in range(_ACTIONS)]
    bits = stream(rng)
    seen = int(model.seen[0])

    class State(pomdp_py.State):
        def __init__(self, code: np.ndarray) -> None:
            self.code = code

        def __hash__(self) -> int:
            return hash(self.code.tobytes())

        def __eq__(self, other: object) -> bool:
            return isinstance(other, State) and bool((self.code == other.code).all())

    class Transition(pomdp_py.TransitionModel):
        def sample(self, state: Any, action: Any) -> Any:
            after = np.empty(_FACTORS, np.int16)
            next_code(model.codes, state.code, 0, int(action.name), after, 0, bits)
            return State(after)

    class Observation(pomdp_py.ObservationModel):
        def sample(self, next_state: Any, action: Any) -> Any:
            return pomdp_py.SimpleObservation(int(next_state.code[seen]))

    class Reward(pomdp_py.RewardModel):
        def sample(self, state: Any, action: Any, next_state: Any) -> float:
            return float(model.reward[0, next_state.code[0]])

    class Policy(pomdp_py.RolloutPolicy):
        def get_all_actions(self, state: Any = None, history: Any = None) -> list[Any]:
            return actions

        def rollout(self, state: Any, history: Any = None) -> Any:
            return actions[int(uniform(bits) * _ACTIONS)]

    class Particles(pomdp_py.GenerativeDistribution):
        def random(self) -> Any:
            return State(belief[rng.integers(len(belief))])

    def work() -> int:
        agent = pomdp_py.Agent(Particles(), Policy(), Transition(), Observation(), Reward())
        search = pomdp_py.POUCT(
            max_depth=_DEPTH, num_sims=_BUDGET, discount_factor=0.95, exploration_const=1.0, rollout_policy=Policy()
        )
        search.plan(agent)
        return int(search.last_num_sims)

    return work


def _tiger(settings: Settings) -> list[Row]:
    import pomdp_py

    from domains.classic import tiger
    from planners.explicit.pomdp import TabularPOMDP
    from planners.explicit.pomdp_py_tabular import TabularAgent
    from planners.search.tree_search import TreeSearch

    rng = np.random.default_rng(settings.seed)
    model = TabularPOMDP(**tiger())
    search = TreeSearch(model, rng, simulations=_BUDGET, depth=_DEPTH, method="po-uct", reuse=False)

    def ours() -> int:
        search.update(0, 0)  # the tree of the last call is not gone on with
        return int(search.plan(model.start)[1]["simulations"])

    class Search(pomdp_py.POUCT):
        def _rollout(self, state: Any, history: Any, root: Any, depth: int) -> float:
            return 0.0

    def theirs() -> int:
        agent = TabularAgent(model, model.start, rng)
        planner = Search(
            max_depth=_DEPTH,
            num_sims=_BUDGET,
            discount_factor=0.95,
            exploration_const=110.0,
            rollout_policy=agent.policy_model,
        )
        planner.plan(agent)
        return int(planner.last_num_sims)

    peer = f"tiger, depth {_DEPTH}: pomdp-py POUCT"
    rates = {f"tiger, depth {_DEPTH}: planners.search.tree_search": rate(ours, settings.seconds)}
    rates[peer] = rate(theirs, settings.seconds)
    return ranked("simulations/s", peer, rates)


def _decision(settings: Settings) -> list[Row]:
    from planners.config import SearchConfig
    from planners.person_following.beliefs import ParticleBelief
    from planners.person_following.ialm import IALM
    from planners.person_following.ialm_search import IALMSearch
    from planners.person_following.kernels import compile_model

    model, config = IALM.load(settings.run.ialm), SearchConfig()
    compiled, rng = compile_model(model), np.random.default_rng(settings.seed)
    search = IALMSearch(model, compiled, config, rng)
    prior = np.full((model.num_factors, model.num_values), 1.0 / model.num_values)
    times: list[float] = []
    started = time.perf_counter()
    while len(times) < 21 or time.perf_counter() - started < settings.seconds:
        belief = ParticleBelief(model, compiled, config.particles, rng)
        code = model.known_codes[rng.integers(len(model.known_codes))]
        belief.reset(code, model.initial_poses[rng.integers(len(model.initial_poses))], prior)
        before = time.process_time()
        action, _ = search.plan(belief.states)
        belief.update(action, code, None, prior)
        times.append(1000.0 * (time.process_time() - before))
    name = f"person following, {config.simulations} simulations and one belief update"
    return [Row(f"{name}: median decision", float(np.median(times[1:])), "ms", name, 1.0)]
