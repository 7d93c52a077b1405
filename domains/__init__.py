"""Domains: batched environments, their exact oracles and their metrics."""

from domains.checker import DomainReport, check_domain
from domains.core import DomainError, load_domain, register_domain

__all__ = [
    "DomainError",
    "DomainReport",
    "check_domain",
    "load_domain",
    "register_domain",
    "register_environments",
]

_ENVIRONMENTS = {"nesy/PersonFollowing-v0": "following", "nesy/Crossing-v0": "crossing"}


def register_environments() -> None:
    """Register the Gymnasium ids of this package; safe to call more than once."""
    from gymnasium.envs.registration import register, registry

    for name, task in _ENVIRONMENTS.items():
        if name not in registry:
            register(
                id=name,
                entry_point="domains.person_following.env:PersonFollowingEnv",
                vector_entry_point="domains.person_following.vector_env:PersonFollowingVectorEnv",
                kwargs={"task": task},
                disable_env_checker=True,
            )


register_environments()
