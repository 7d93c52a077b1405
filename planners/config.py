"""Settings of the planners and of their comparison: plain dataclasses, cheap to import.

Every field's docstring is its help text on the command line.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from domains.core import DISCOUNT
from nesy.config import check_ranges
from nesy.errors import UserError
from nesy.perspective.influence import INFLUENCE_MODES

INPUT_SETS = ("paper", "full")
LEARNING_AGENTS = ("dqn",)
TABLE_PLANNERS = ("pomdp", "search", "qmdp")
"""Plan with the learned local model: the extracted 2DBN and an influence prior through the perspective shift."""
PLANNING_AGENTS = (*TABLE_PLANNERS, "structured")
"""`structured` plans with hand-structured models of person following whose parameters are learned."""
ORACLES = ("optimum", "bayes-optimum", "egocentric-optimum")
REFERENCE_AGENTS = ("greedy-follower", "greedy-last-seen", "random", *ORACLES)
AGENTS = LEARNING_AGENTS + PLANNING_AGENTS + REFERENCE_AGENTS
MOST_SIMULATIONS = 1_000_000
"""Per second, more than any search here makes: the room that trees get where time is limited, which costs time too."""


@dataclass(frozen=True)
class DQNConfig:
    """How the belief DQN learns."""

    episodes: int = 4000
    """Training episodes (the batch finishes the ones it has begun)."""
    steps: int = 0
    """Environment steps to train for, instead of a number of episodes; 0 for the number."""
    num_envs: int = 64
    """Environments stepped at once."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers."""
    dueling: bool = True
    """Whether value and advantage have heads of their own."""
    layer_norm: bool = True
    """Whether hidden layers are normalised."""
    learning_rate: float = 1e-3
    """Adam's step size at the start."""
    final_learning_rate: float = 1e-4
    """Adam's step size at the end (linear in between)."""
    batch_size: int = 256
    """Transitions in one update."""
    memory: int = 60_000
    """Transitions kept for replay."""
    discount: float | None = None
    """Discount per step; left out: as the variant says."""
    n_step: int = 3
    """Steps of reward before the value estimate takes over."""
    warm_up: int = 2000
    """Environment steps before the first update."""
    updates_per_step: float = 0.05
    """Gradient steps per environment step."""
    epsilon_start: float = 0.7
    """Probability of a random action at the start."""
    epsilon_end: float = 0.02
    """Probability of a random action at the end."""
    epsilon_decay: float = 0.2
    """Time constant of the decay of the exploration, as a share of all episodes."""
    tau: float = 0.02
    """Share by which the target network moves towards the network per update."""
    gradient_clip: float = 10.0
    """Largest norm of the gradient."""
    reward_scale: float = 0.1
    """Rewards are multiplied by this before learning."""
    double: bool = True
    """Whether the online network chooses the action that the target network values."""
    prioritised: bool = False
    """Whether replay prefers transitions with a large error."""
    bootstrap: Literal["timeout", "truncated"] = "timeout"
    """Which endings are only the clock's, so that the value of what would have followed counts."""
    target_period: int = 0
    """Updates between copies of the network into the target network; 0: it moves a little with every update (tau)."""
    fallback: Literal["uniform", "mode", "published"] = "uniform"
    """What b~ is while the person is out of view: uniform in every mode; what the mode would have all the same (the
    true code, say); or as in the published code: zeros for perspective-shift, what the mode has for the others."""
    checkpoint_seconds: float = 30.0
    """Seconds between the checkpoints that a stopped training goes on from; the results do not depend on it."""
    published_terminals: bool = False
    """As the published code: bootstrap from terminal transitions as if the episode went on."""
    published_target_start: bool = False
    """As the published code: the target network starts from other weights than the network."""
    published_sampling: bool = False
    """As the published code: b~ is not a distribution but a relaxed sample of it (temperature 0.6)."""
    published_occlusion: bool = False
    """As the published code: perfect information has the person unable to look through walls."""

    def __post_init__(self) -> None:
        """Check every number."""
        sizes = ("episodes", "num_envs", "batch_size", "memory", "hidden", "n_step")
        positive = ("learning_rate", "updates_per_step", "epsilon_decay", "gradient_clip", "reward_scale")
        others = ("steps", "final_learning_rate", "warm_up", "target_period", "checkpoint_seconds")
        shares = ("discount", "epsilon_start", "epsilon_end", "tau")
        check_ranges(
            self,
            "dqn",
            **dict.fromkeys(sizes, "[1, inf)"),
            **dict.fromkeys(positive, "(0, inf)"),
            **dict.fromkeys(others, "[0, inf)"),
            **dict.fromkeys(shares, "[0, 1]"),
        )

    @property
    def per_step(self) -> float:
        """Discount per step; outside of any variant the usual one."""
        return DISCOUNT if self.discount is None else self.discount

    def at(self, discount: float) -> DQNConfig:
        """These settings with the discount of a variant, unless they have one of their own."""
        return self if self.discount is not None else replace(self, discount=discount)

    @classmethod
    def paper(cls, episodes: int = 10_000) -> DQNConfig:
        """The settings of the paper: one environment, one update per step."""
        return cls(
            episodes=episodes,
            num_envs=1,
            hidden=(500, 500),
            dueling=False,
            layer_norm=False,
            learning_rate=1e-3,
            final_learning_rate=1e-3,
            batch_size=64,
            memory=60_000,
            n_step=1,
            warm_up=1000,
            updates_per_step=1.0,
            epsilon_start=0.7,
            epsilon_end=0.01,
            epsilon_decay=0.2,
            tau=0.005,
            gradient_clip=10.0,
            reward_scale=1.0,
        )

    @classmethod
    def published(cls, episodes: int = 10_000) -> DQNConfig:
        """The settings of the paper with everything in which the published code differs from the text."""
        return replace(
            cls.paper(episodes),
            published_terminals=True,
            published_target_start=True,
            fallback="published",
            published_sampling=True,
            published_occlusion=True,
        )

    @classmethod
    def fast(cls, episodes: int = 4000) -> DQNConfig:
        """The settings that learn best per second here: many environments, few large updates."""
        return cls(episodes=episodes)


LearnerName = Literal["fast", "paper", "published"]
LEARNERS = {"fast": DQNConfig.fast, "paper": DQNConfig.paper, "published": DQNConfig.published}
"""Settings of the DQN by name, for a number of episodes."""


@dataclass(frozen=True)
class SearchConfig:
    """How the planners search."""

    simulations: int = 1000
    """Simulations per decision."""
    time_limit: float = 0.0
    """Seconds per decision, perception and belief included, after which the search stops early; 0 for no limit (and
    repeatable results)."""
    depth: int = 12
    """Deepest step looked ahead."""
    discount: float | None = None
    """Discount per step; left out: as the variant says."""
    exploration: float = 10.0
    """Weight of the exploration term (UCB1), in units of reward."""
    particles: int = 400
    """Particles of the belief over (x, y, c, counters)."""
    practice_episodes: int = 12_000
    """Person-following episodes, besides the run's experience, that the planner's tables are learned from."""
    practice_steps: int = 0
    """Steps of these episodes that are learned from; 0 for all."""
    practice_mixture: float = 0.3
    """Probability that the switching behaviour of these episodes acts at random."""
    mind_depth: int = 25
    """Deepest step looked ahead there."""
    mind_exploration: float = 40.0
    """Weight of the exploration term there, in units of reward."""
    pomdp_py_simulations: int = 150
    """Simulations per decision of pomdp-py's POUCT, which is far slower per simulation."""

    def __post_init__(self) -> None:
        """Check every number."""
        sizes = ("simulations", "pomdp_py_simulations", "depth", "mind_depth", "particles", "practice_episodes")
        check_ranges(
            self,
            "search",
            **dict.fromkeys(sizes, "[1, inf)"),
            **dict.fromkeys(("time_limit", "exploration", "mind_exploration", "practice_steps"), "[0, inf)"),
            discount="[0, 1)",
            practice_mixture="[0, 1]",
        )

    @property
    def per_step(self) -> float:
        """Discount per step; outside of any variant the usual one."""
        return DISCOUNT if self.discount is None else self.discount

    def at(self, discount: float) -> SearchConfig:
        """These settings with the discount of a variant, unless they have one of their own."""
        return self if self.discount is not None else replace(self, discount=discount)

    def time_left(self, spent: float) -> float:
        """What is left for a search of a decision that has taken `spent` seconds already; 0 where there is no limit."""
        return max(self.time_limit - spent, 1e-6) if self.time_limit > 0 else 0.0


@dataclass(frozen=True)
class CompareConfig:
    """What is compared: the grid of agents x input sets x influence modes x variants x seeds."""

    agents: tuple[str, ...] = tuple(agent for agent in AGENTS[:-1] if agent not in ("qmdp", "structured"))
    """Which agents: dqn; pomdp (pomdp-py), search and qmdp, which plan with the 2DBN; structured, which plans with
    hand-structured models (where the task has one); greedy-follower, greedy-last-seen, random; and the exact oracles
    optimum (full state), bayes-optimum and egocentric-optimum (where the task is small enough)."""
    inputs: tuple[str, ...] = ("full",)
    """Input sets of the DQN: paper (b, b~) or full (b, b~ and the configuration)."""
    influences: tuple[str, ...] = ("random", "perspective-shift", "perfect-information")
    """Influence modes: zero, random, egocentric, perspective-shift, perfect-information."""
    variants: tuple[str, ...] = ("paper",)
    """Variants of the task."""
    seeds: tuple[int, ...] = (0,)
    """Seeds; every cell is run once per seed."""
    episodes: int = 168
    """Evaluation episodes per seed, the same maps and seeds for all (`paper`: a multiple of its 42 maps)."""
    planner_episodes: int = 42
    """Evaluation episodes per seed for the agents that plan (`pomdp`, `search`, `qmdp`, `structured`)."""
    confidence: float = 0.95
    """Coverage of the intervals."""
    planner_milliseconds: float = 0.0
    """Time that the agents that search get per decision, from what they see to what they do, instead of a number of
    simulations; 0 for the number. Agents compare at equal time then, but results no longer repeat exactly."""
    learning_steps: int = 0
    """Environment steps that every agent learns from, a DQN from its training and a planner from its practice, instead
    of numbers of episodes; 0 for the numbers. Agents compare at equal experience then."""
    rules: tuple[str, ...] = ()
    """Rule files (docs/asp.md) that no agent may break, neither while it learns nor when it acts. Rules about the
    person act on what the planners expect of it."""
    policies: tuple[str, ...] = ()
    """Trained policies (.safetensors files) to compare besides, as they are."""
    dqn: DQNConfig = field(default_factory=DQNConfig.fast)
    """How the DQN learns."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """How the planners search."""

    def __post_init__(self) -> None:
        """Check every name and number; whether a domain has the variants is its own to say."""
        for name, chosen, known in (
            ("agent", self.agents, AGENTS),
            ("input set", self.inputs, INPUT_SETS),
            ("influence mode", self.influences, INFLUENCE_MODES),
        ):
            for item in chosen:
                if item not in known:
                    raise UserError(f"unknown {name} '{item}' (known: {', '.join(known)})")
        for name in ("agents", "inputs", "influences", "variants", "seeds"):
            values = getattr(self, name)
            if not values and not (name == "agents" and self.policies):
                raise UserError(f"nothing to compare: the list of {name} is empty")
            if len(set(values)) < len(values):
                raise UserError(f"compare: {name} names something twice: {', '.join(map(str, values))}")
        check_ranges(
            self,
            "compare",
            seeds="[0, inf)",
            episodes="[1, inf)",
            planner_episodes="[1, inf)",
            confidence="(0, 1)",
            planner_milliseconds="[0, inf)",
            learning_steps="[0, inf)",
        )

    def at(self, discount: float) -> CompareConfig:
        """These settings with the discount of a variant for all who learn or plan, unless they have their own."""
        return replace(self, dqn=self.dqn.at(discount), search=self.search.at(discount))

    @property
    def dqn_of_cells(self) -> DQNConfig:
        """How the DQN learns here: from as many steps as all agents, if that is asked for."""
        return replace(self.dqn, steps=self.learning_steps) if self.learning_steps else self.dqn

    @property
    def search_of_cells(self) -> SearchConfig:
        """How the planners practise and search here: as many steps as all agents, and by time, if that is asked for."""
        search = replace(self.search, practice_steps=self.learning_steps) if self.learning_steps else self.search
        if self.planner_milliseconds <= 0:
            return search
        seconds = self.planner_milliseconds / 1000.0
        enough = max(1000, int(seconds * MOST_SIMULATIONS))
        return replace(search, time_limit=seconds, simulations=enough)
