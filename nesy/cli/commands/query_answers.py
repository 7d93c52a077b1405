"""The answers of `nesy query`: each question of the command line put to the knowledge base."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from nesy.errors import UserError

if TYPE_CHECKING:
    from nesy.asp import Answer, KnowledgeBase
    from nesy.cli.commands.query import Arguments


def _means(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    return knowledge.means(*_factor_and_value("--means", options.means or "")).to_dict()


def _when(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    asked = options.when or ""
    if "=" in asked:
        return knowledge.value_rules(*_factor_and_value("--when", asked)).to_dict()
    return knowledge.rules(asked).to_dict()


def _verify(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    property_ = (options.premise, options.conclusion, options.codes, options.least)
    return knowledge.verify(options.verify or "", *property_).to_dict()


def _plan(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    start, limits = _start(knowledge, options.start), {"rules": options.rules, "time_limit": options.time_limit}
    if options.plan is not None:
        return knowledge.plan(start, options.plan, options.max_steps, **limits).to_dict()
    return knowledge.trajectory(start, options.trajectory or "", options.max_steps, **limits).to_dict()


def _reach(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    return knowledge.reachable(_start(knowledge, options.start), options.reach or "", options.max_steps).to_dict()


def _after(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    return knowledge.after(_start(knowledge, options.start), options.after, options.least).to_dict()


def _explain(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    explanation = knowledge.explain(_start(knowledge, options.start), options.explain or "")
    return {
        "question": f"Why does {options.explain} lead there?",
        "text": explanation.text,
        "support": [list(edge) for edge in explanation.support],
    }


def _knows(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    if options.views:
        codes = [_start(knowledge, str(view)) for view in options.views]
        return knowledge.knows(codes, options.knows).to_dict()
    start = _start(knowledge, options.start)
    return knowledge.person_knows(start, _configuration(knowledge, options.person), options.knows).to_dict()


def _shield(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    from nesy.asp.shield import usual_fallback

    if not options.rules:
        raise UserError("--shield needs --rules FILE")
    return knowledge.allowed(
        options.rules,
        _start(knowledge, options.start),
        _configuration(knowledge, options.person),
        fallback=options.fallback or usual_fallback(knowledge.dbn.action_names),
        time_limit=options.time_limit,
    ).to_dict()


def _constrain(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    if not options.rules:
        raise UserError("--constrain needs --rules FILE")
    model, removal = knowledge.constrained(options.rules, time_limit=options.time_limit)
    text = (
        f"{removal.entries} entries are impossible by the rules; {removal.rows} rows were renormalised "
        f"({100 * removal.visits:.2f} % of all visits); the most that one of them lost is {removal.largest:.3g}"
    )
    if options.out is not None:
        if options.out.exists():
            raise UserError(f"{options.out}: is there already; name a new folder")
        model.save(options.out)
        knowledge.book.save(options.out)
        text += f"\nThe model that is left: {options.out}"
    support = [[place, head, "rule"] for place, head in removal.examples]
    return {
        "question": "What do the rules remove?",
        "text": text,
        "entries": removal.entries,
        "rows": removal.rows,
        "largest": removal.largest,
        "visits": removal.visits,
        "support": support,
    }


def _why(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    import numpy as np

    from domains.core import load_domain
    from nesy.asp.semantics.predicates import ordered, value_rules
    from nesy.asp.semantics.rules import applies, sentence
    from nesy.cli import configuration
    from nesy.run_folder import RunFolder
    from planners.comparison.replay.why import explain_choice, find_cell

    run = RunFolder.open(options.run)
    config = configuration.load(run.config)
    domain = load_domain(config.domain)
    book = knowledge.book
    start = _start(knowledge, options.start)
    having = [view for view, code in enumerate(book.codes.tolist()) if code == start]
    if not having:
        raise UserError(f"--start {options.start}: no view met has this code")
    place = _configuration(knowledge, options.person)
    choice = explain_choice(
        run,
        domain,
        config.compare,
        find_cell(run, config.compare, options.why or ""),
        book.views[having[0]],
        place,
        config.seed,
        tuple(str(path) for path in options.rules),
    )
    lines = [choice.text]
    support = [[rule, f"not {action}", "rule"] for action, rules in choice.because.items() for rule in rules]
    names = ordered(book.predicate_names)
    truth = np.array([[int(book.predicate(name)[having[0]]) for name in names]])
    lines.append("  what the code says:")
    for factor, value in enumerate(choice.code):
        label = f"{knowledge.dbn.factor_names[factor]} = {value}"
        held = value_rules(book, factor, value, held_out=0.0)
        for rule in held.rules:
            if applies([rule], truth)[0]:
                lines.append(f"    {label} because {sentence(rule, names, True)}")
                support.append([sentence(rule, names, True), label, "rule"])
        support.append([label, choice.action, ""])
    step = knowledge.explain(choice.code, choice.action)
    lines += ["  what it leads to most probably:", *("    " + line for line in step.text.splitlines())]
    return {
        "question": f"Why does {choice.agent} choose {choice.action}?",
        "text": "\n".join(lines),
        "agent": choice.agent,
        "algorithm": choice.algorithm,
        "model": choice.model,
        "action": choice.action,
        "values": choice.values,
        "visits": choice.visits,
        "allowed": list(choice.allowed),
        "because": {name: list(rules) for name, rules in choice.because.items()},
        "code": list(choice.code),
        "shifted": None if choice.shifted is None else list(choice.shifted),
        "influence": choice.influence,
        "support": support,
    }


def _program(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    assert options.program is not None
    answer = knowledge.query(options.program, rules=options.rules, models=options.models, time_limit=options.time_limit)
    return {**answer.to_dict(), "text": _answer_text(answer)}


def _vocabulary(knowledge: KnowledgeBase, options: Arguments) -> dict[str, Any]:
    from nesy.asp.program.names import encode

    facts, book = knowledge.facts.vocabulary(), knowledge.codebook
    names = () if book is None else map(encode, book.predicate_names)
    predicates = {} if book is None else dict(zip(names, book.predicate_meanings, strict=True))
    lines = []
    for title, words in (("Facts that a program can use:", facts), ("Observable predicates P:", predicates)):
        width = max(map(len, words), default=0)
        lines += [title, *(f"  {name:{width}}  {meaning}" for name, meaning in words.items())]
    return {"facts": facts, "predicates": predicates, "text": "\n".join(lines)}


def _start(knowledge: KnowledgeBase, text: str) -> list[int]:
    """The code that --start names.

    Raises:
        UserError: neither the number of a view met in experience nor a code.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise UserError(f"--start {text}: expected the number of a view, or a code of comma-separated values")
    if len(parts) > 1:
        return [int(part) for part in parts]
    views = 0 if knowledge.codebook is None else len(knowledge.codebook)
    if knowledge.codebook is None or int(text) >= views:
        raise UserError(f"--start {text}: no such view; the model's views are 0 to {views - 1}")
    return [int(value) for value in knowledge.codebook.codes[int(text)]]


def _configuration(knowledge: KnowledgeBase, text: str) -> int:
    """The configuration that --person names.

    Raises:
        UserError: no place in the view.
    """
    from domains.core import DomainError, ViewGeometry

    if text == "unseen":
        return 0
    geometry = ViewGeometry(knowledge.book.views.shape[1])
    try:
        side, ahead, heading = (int(part) for part in text.split(","))
        return int(geometry.encode(geometry.viewer[0] + side, geometry.viewer[1] - ahead, heading))
    except (ValueError, DomainError):
        raise UserError(
            f"--person {text}: expected side,ahead,heading inside the view (such as 0,1,2), or unseen"
        ) from None


def _answer_text(answer: Answer) -> str:
    """The models, one per paragraph, and what is known about completeness."""
    lines = []
    for number, (atoms, cost) in enumerate(zip(answer.models, answer.costs, strict=True), start=1):
        suffix = f" (cost {' '.join(map(str, cost))})" if cost else ""
        lines += [f"Model {number}{suffix}:", *(f"  {atom}" for atom in atoms)]
    if answer.satisfiable is None:
        lines.append("No answer within the time limit.")
    elif not answer.satisfiable:
        lines.append("No model: the program is unsatisfiable.")
    elif not answer.exhausted:
        lines.append("There may be further models (--models 0 for all, --time-limit for longer).")
    if not answer.optimal:
        lines.append("Not proven optimal within the time limit.")
    if answer.dropped:
        lines.append(f"The facts leave out at most {answer.dropped:.2g} of a row's probability.")
    lines += [f"Note: {note}" for note in answer.notes]
    lines.append(f"{answer.seconds['total']:.3f} s")
    return "\n".join(lines)


def _factor_and_value(option: str, text: str) -> tuple[str, int]:
    factor, equals, value = text.partition("=")
    if not equals or not factor.strip() or not value.strip().isdecimal():
        raise UserError(f"{option} {text}: expected FACTOR=VALUE, such as 3=5")
    return factor.strip(), int(value)


QUESTIONS: dict[str, Callable[[KnowledgeBase, Arguments], dict[str, Any]]] = {
    "means": _means,
    "predicate": lambda knowledge, options: knowledge.implies(options.predicate or "").to_dict(),
    "when": _when,
    "changes": lambda knowledge, options: knowledge.influenced(options.changes or "").to_dict(),
    "verify": _verify,
    "plan": _plan,
    "trajectory": _plan,
    "reach": _reach,
    "after": _after,
    "explain": _explain,
    "knows": _knows,
    "shield": _shield,
    "constrain": _constrain,
    "why": _why,
    "vocabulary": _vocabulary,
    "program": _program,
}
