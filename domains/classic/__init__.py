"""Small POMDPs with known optimal values, as plain arrays: they certify planners.

Each function returns the keyword arguments of `planners.explicit.pomdp.TabularPOMDP`: names of states, actions and
observations, transition (one matrix [S, S] per action), observation [A, S', O], reward [A, S], discount, start [S]
and terminal [S].
"""

from domains.classic.rocksample import rocksample
from domains.classic.tiger import tiger

__all__ = ["rocksample", "tiger"]
