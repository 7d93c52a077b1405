"""Worlds by name: our own by their names, anybody's as `package.module:ATTRIBUTE`."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import Any

from domains.vocabulary import DomainError, DomainSpec

_REGISTRY = {"person_following": "domains.person_following:DOMAIN"}
_LOCATION = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")


def register_domain(name: str, location: str) -> None:
    """Make `load_domain(name)` import `location`, written `package.module:ATTRIBUTE`.

    Raises:
        DomainError: the location is not written so.
    """
    if not _LOCATION.fullmatch(location):
        raise DomainError(f"a domain's location is 'package.module:ATTRIBUTE', got '{location}'")
    _REGISTRY[name] = location


def location_of(name: str) -> str:
    """What another process can load the world by: names registered in this one are unknown there.

    Raises:
        DomainError: neither a registered name nor a location.
    """
    if name in _REGISTRY:
        return _REGISTRY[name]
    if _LOCATION.fullmatch(name):
        return name
    known = ", ".join(sorted(_REGISTRY))
    raise DomainError(f"unknown domain '{name}': known are {known}; one of your own is package.module:ATTRIBUTE")


def found(name: str) -> Any:
    """The domain of a name, as its author wrote it.

    Raises:
        DomainError: no such name, it cannot be imported, or what is there is no domain.
    """
    module_name, _, attribute = location_of(name).partition(":")
    value: Any = _imported(name, module_name)
    for part in attribute.split("."):
        if not hasattr(value, part):
            there = getattr(value, "__file__", None) or module_name
            raise DomainError(f"world '{name}': {there} has no attribute '{part}'")
        value = getattr(value, part)
    _check(name, attribute, value)
    return value


def _imported(name: str, module: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)  # last, so that nothing here hides an installed package
        importlib.invalidate_caches()
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and (module == error.name or module.startswith(error.name + ".")):
            reason = f"there is no module '{error.name}', neither installed nor in {here}"
        else:
            reason = f"importing {module} failed: {error}"
        raise DomainError(f"world '{name}': {reason}") from error
    except (Exception, SystemExit) as error:  # whatever somebody else's module does
        what = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DomainError(f"world '{name}': importing {module} failed ({what})") from error


def _check(name: str, attribute: str, value: Any) -> None:
    """Whether this is a domain: the rest is for `check_domain` to say."""
    if isinstance(value, type):
        raise DomainError(
            f"world '{name}': {attribute} is a class; name an instance of it, such as DOMAIN = {attribute}()"
        )
    if not isinstance(getattr(value, "spec", None), DomainSpec):
        raise DomainError(f"world '{name}': {attribute} is no domain, it has no spec that is a DomainSpec")
    for member in ("make", "predicates"):
        if not hasattr(value, member):
            raise DomainError(f"world '{name}': {attribute} is no domain, it has no {member}")
