"""Rule files are text from strangers: nothing runs, nothing hangs, each gets one clear line."""

import contextlib
import os
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nesy.asp import KnowledgeBase
from nesy.errors import UserError
from tests.nesy.dbn.toy import toy

LIMIT = 1.0

# name -> (program, what the message must hold)
HOSTILE = {
    "python": ('#script (python)\nimport os\nos.system("touch MARKER")\n#end.', "1:1: script"),
    "lua": ('a.\n#script (lua)\nos.execute("touch MARKER")\n#end.', "2:1: script"),
    "script after spaces": ("a. #   script (python) #end.", "script"),
    "script behind a comment": ("%* x *% #script (python) #end.", "script"),
    "script in a nested comment's end": ("%* %* *% *% #script (python) #end.", "script"),
    "script after a string with a quote": (r'a("\"%*"). #script (python) #end. b("*%").', "script"),
    "include of a system file": ('#include "/etc/passwd".', "outside"),
    "include of a parent folder": ('#include "../../../etc/hostname".', "outside"),
    "include of the library": ("#include <incmode>.", "only #include"),
    "include without a file": ("#include.", "only #include"),
    "include of a missing file": ('#include "nowhere.lp".', "no such file"),
    "include of a link that leads out": ('#include "link.lp".', "outside"),
    "include of itself": ('#include "rules.lp". a.', None),
    "grounding without end": ("n(0). n(X+1) :- n(X).", "not grounded within"),
    "a function that grows": ("t(a). t(f(X)) :- t(X).", "not grounded within"),
    "a product of ranges": ("p(1..100000000).", "(not grounded within|MB|memory|without an answer)"),
    "a join that explodes": ("n(1..3000). p(X,Y,Z) :- n(X), n(Y), n(Z).", "(not grounded within|MB|memory)"),
    "a counting aggregate": ("n(1..40). 1 { p(X) : n(X) }. :- #sum { X*X*X,X : p(X) } != 31415.", None),
    "the pigeons": ("1 { in(P,H) : H = 1..12 } 1 :- P = 1..13. :- in(P,H), in(Q,H), P < Q.", None),
    "all subsets": ("{ p(1..60) }.", None),
    "syntax": ("a :- b\nc.", "2:1"),
    "unclosed string": ('a("b).', "1:3"),
    "unclosed comment": ("a. %* never closed", "1:4"),
    "unsafe variable": ("a(X) :- not b(X).", "unsafe"),
    "unsafe head": ("\n\np(X,Y) :- q(X). q(1).", "3:1"),
    "function call": ("a(@os_system(1)).", None),
    "theory without grammar": ("&diff { a - b } <= 3.", "theory"),
    "redefinition": ("#const n = 1. #const n = 2. p(n).", "redefinition"),
    "cyclic constant": ("#const a = b. #const b = a. p(a).", "cyclic"),
    "deep term": ("p(" + "f(" * 50_000 + "a" + ")" * 50_000 + ").", ":1:[0-9]+: nested more than 1000 deep"),
    "deep negation": ("p :- " + "not " * 3 + "q.", "syntax error"),
    "externals": ("#external p(1..3). a :- p(1).", None),
    "an external that is unsafe": ("#external p(X) : not q(X).", "unsafe"),
    "another program part": ("#program step(t). p(t). n(0). n(X+1) :- n(X).", None),
    "the base part with parameters": ("#program base(x). p(x).", None),
    "an edge into the solver": ("#edge (X,X) : X = 1..3.", None),
    "a heuristic": ("{ a }. #heuristic a. [1,true]", None),
    "projection of everything": ("{ a(1..40) }. #project a/1.", None),
    "a huge file": ("p(1). " * 2_000_000, "longer than"),
    "wrong bytes": (b"a.\ncaf\xe9(1).", ":2:4: not UTF-8"),
    "utf-16": ("a.".encode("utf-16"), ":1:1: not UTF-8 text .*UTF-16"),
    "nul": (b"a.\n\0b.", ":2:1: holds a NUL"),
    "nul in a comment": (b"a. % \0", ":1:6: holds a NUL"),
    "binary": (bytes(range(1, 256)), "(UTF-8|error)"),
    "no-break space": ("forbidden(forward) :-\u00a0now(wall_ahead).", ":1:22: U\\+00A0 NO-BREAK SPACE .* ' ' meant"),
    "another space": ("a.\n  b :- a,\u2003c.", ":2:10: U\\+2003 EM SPACE"),
    "a space without width": ("a\u200b.", ":1:2: U\\+200B"),
    "form feed": ("a.\fb.", ":1:3: U\\+000C"),
    "delete": ("a\x7f.", ":1:2: U\\+007F"),
    "typographic quotes": ("a(\u201cx\u201d).", ":1:3: '\u201c' U\\+201C .*'\"' meant"),
    "a long dash": ("a(1\u20132).", ":1:4: '\u2013' .*'-' meant"),
    "umlaut": ("gr\u00f6\u00dfe(1).", ":1:3: '\u00f6' U\\+00F6"),
    "umlaut behind a string": ('a("\u00f6",\u00f6).', ":1:7: '\u00f6'"),
    "a byte order mark inside": ("a.\n\ufeffb.", ":2:1: U\\+FEFF"),
    "another backslash in a string": ('a("\\t\u00fc").', ":1:3: a string is not closed"),
    "unclosed string with an umlaut": ('a("\u00fc.\n', ":1:3: a string is not closed"),
    "syntax behind an umlaut": ('a("\u00fc") :- b("\u00fc"), c(.', ":1:21-22: error: syntax error"),
    "large number": ("a(2147483648).", ":1:3: 2147483648 is too large"),
    "large number after an operator": ("a. b(X) :- X=1+99999999999999999999.", ":1:16: 9+ is too large"),
    "hexadecimal": ("a(0x80000000).", ":1:3: 0x80000000 is too large"),
    "octal": ("a(0o20000000000).", "too large"),
    "binary number": ("a(0b1" + "0" * 31 + ").", "too large"),
    "large weight": (":~ a. [4294967297] {a}.", ":1:8: 4294967297 is too large"),
    "a number of many digits": ("a(" + "9" * 9000 + ").", ":1:3: 9+ is too large"),
    "deep operators": ("p(1" + "+1" * 30_000 + ").", ":1:2002: nested more than 1000 deep"),
    "deep operators over brackets": ("p(1" + "+f(1,1)" * 30_000 + ").", "nested more than 1000 deep"),
    "deep negative": ("p(" + "-" * 30_000 + "1).", "nested more than 1000 deep"),
    "deep tuples": ("p(" + "(" * 30_000 + "a" + ",)" * 30_000 + ").", "nested more than 1000 deep"),
}
MUST_FAIL = {name for name, (_, message) in HOSTILE.items() if message}


@pytest.fixture(scope="module")
def base():
    return KnowledgeBase(*toy())


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_rule_file(base, tmp_path, monkeypatch, name):
    program, message = HOSTILE[name]
    marker = tmp_path / "marker"
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "rules"
    folder.mkdir()
    (folder / "link.lp").symlink_to("/etc/hostname")
    path = folder / "rules.lp"
    content = program if isinstance(program, bytes) else program.replace("MARKER", str(marker)).encode()
    path.write_bytes(content)
    started = time.monotonic()
    try:
        answer = base.query(path, models=2, time_limit=LIMIT, memory_mb=512)
    except UserError as error:
        text = str(error)
        assert "\n" not in text and len(text) < 2000
        assert str(path) in text and "PANIC" not in text
        if message:
            import re

            assert re.search(message, text), text
    else:
        assert name not in MUST_FAIL, answer
    assert time.monotonic() - started < LIMIT + 1.5
    assert not marker.exists()


def entrances(base, path):
    """Every way of a rule file into clingo, without the command line."""
    from nesy.asp.shield import PERSON

    limits = {"time_limit": LIMIT, "memory_mb": 512}
    return (
        lambda: base.query("b.", rules=path, **limits),
        lambda: base.allowed(path, [0, 0, 0], **limits),
        lambda: base.shield(path, role=PERSON, **limits),
        lambda: base.plan([0, 0, 0], "wall_ahead", rules=path, time_limit=LIMIT),
        lambda: base.constrained(path, **limits),
    )


@pytest.mark.parametrize("name", ["no-break space", "large number", "deep negative", "wrong bytes", "lone surrogate"])
def test_every_entrance_says_where(base, tmp_path, name):
    content, message = HOSTILE.get(name, ('a("\ud800").', ":1:4: holds a lone surrogate"))
    path = tmp_path / "rules.lp"
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    if name == "lone surrogate":
        message = ":1:4: not UTF-8"
        with pytest.raises(UserError, match=r"program:1:4: holds a lone surrogate \(U\+D800\)"):
            base.query(content)
    for entrance in entrances(base, path):
        with pytest.raises(UserError, match=message) as caught:
            entrance()
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["\ufeffforbidden(go) :- now(wall_ahead).", "% \u00fc \u201c\u00a0\nforbidden(go). %* \u00fc *%"]
)
def test_a_byte_order_mark_is_read_and_comments_may_hold_anything(base, tmp_path, text):
    path = tmp_path / "r\u00fcles.lp"
    path.write_text(text, encoding="utf-8")
    more = tmp_path / "more.lp"
    more.write_text(f'\ufeff#include "{path.name}".', encoding="utf-8")
    for rules in (text, path, more):
        assert base.shield(rules).predicates == (("wall_ahead",) if "wall" in text else ())
    advice = base.shield(path).advise(base.codebook.codes[0], base.codebook.predicate("wall_ahead")[:0] | True, 0)
    assert all(place.startswith(f"{path}:") for places in advice.because.values() for place in places)


def test_strings_hold_any_text(base):
    answer = base.query('a("gr\u00f6\u00dfe \u201cx\u201d\u00a0\U0001f600\u2028"). #show a/1.')
    assert answer.models == (('a("gr\u00f6\u00dfe \u201cx\u201d\u00a0\U0001f600\u2028")',),)


def test_numbers_of_32_bits_and_long_rules_are_taken(base):
    answer = base.query("a(2147483647;-2147483647;0x7fffffff). b(x99999999999,_y2147483648). #show a/1.")
    assert answer.models == (("a(-2147483647)", "a(2147483647)"),)
    body = ", ".join(f"X{i}=1+{i}*(2-{i})" for i in range(700))
    assert base.query(f"p(X5) :- {body}. #show p/1.").models == (("p(-14)",),)
    assert base.query("p(" + "f(" * 900 + "a" + ")" * 900 + "). #show.").satisfiable


def test_counts_beyond_32_bits_are_no_facts():
    from dataclasses import replace

    dbn, book = toy()
    counts = dbn.row_counts.copy()
    counts[0] = 2**31
    large = KnowledgeBase(replace(dbn, row_counts=counts), book)
    with pytest.raises(UserError, match="2147483648 is too large"):
        large.query("a(C) :- met(_,_,_,C).")


PIECES = st.one_of(
    st.text(max_size=8),
    st.sampled_from(
        ["a", "X", "p(", ")", ".", " :- ", ",", ";", "not ", '"', "\\", "%", "%*", "*%", "\n", "#show ", "1", "-"]
    ),
    st.sampled_from(
        ["\u00a0", "\u201c", "\u00fc", "\ufeff", "\0", "\ud800", "2147483648", "{", "}", "#const ", "|", "..", "@"]
    ),
)


@settings(max_examples=300, deadline=None)
@given(st.lists(PIECES, max_size=12).map("".join))
def test_what_is_not_refused_passes_clingos_reader(text):
    """In this process: a character unknown to clingo would end it."""
    from clingo import ast

    from nesy.asp.program.sources import read_sources

    try:
        (source,) = read_sources([text + " "])
    except UserError as error:
        assert str(error).startswith("program:1:") or "\n" in text
        return
    assert [len(line) for line in source.text.split("\n")] == [
        len(line) for line in (text + " ").removeprefix("\ufeff").split("\n")
    ]
    messages = []
    with contextlib.suppress(RuntimeError):
        ast.parse_string(source.text, lambda statement: str(statement), logger=lambda _, m: messages.append(m))
    assert all(isinstance(message, str) for message in messages)


@settings(max_examples=25, deadline=None)
@given(st.lists(PIECES, max_size=12).map("".join))
def test_any_text_is_answered_or_refused_in_one_line(text):
    base = KnowledgeBase(*toy())
    for entrance in (base.query, base.shield):
        try:
            entrance(text + " ", time_limit=LIMIT)
        except UserError as error:
            assert "\n" not in str(error) and "memory" not in str(error) and "crashed" not in str(error)


def test_an_included_file_of_the_same_folder_is_read(base, tmp_path):
    (tmp_path / "more.lp").write_text("known(1).")
    (tmp_path / "rules.lp").write_text('#include "more.lp".\nfound(X) :- known(X).\n#show found/1.')
    assert base.query(tmp_path / "rules.lp").models == (("found(1)",),)


def test_errors_name_the_file_among_several(base, tmp_path):
    good, bad = tmp_path / "good.lp", tmp_path / "bad.lp"
    good.write_text("a.")
    bad.write_text("a.\n  b :- c(.\n")
    with pytest.raises(UserError, match=r"bad\.lp:2:10"):
        base.query(good, rules=[bad])


def test_comments_and_strings_may_mention_anything(base):
    program = '% #script (python)\n%* #include "x" *% a("#script #include % %*"). #show a/1.'
    assert base.query(program).models == (('a("#script #include % %*")',),)


def test_a_search_without_end_gives_what_it_found(base):
    program = "{ p(1..60) }. :- #count { X : p(X) } < 1. #show p/1."
    answer = base.query(program, models=0, time_limit=0.5)
    assert answer.satisfiable and answer.models and not answer.exhausted


def test_undefined_predicates_are_noted(base):
    answer = base.query("a :- misspelt(1).")
    assert any("misspelt" in note for note in answer.notes)


def test_interrupting_a_query_ends_its_process(base, monkeypatch):
    import signal
    import subprocess
    import threading

    started: list[subprocess.Popen] = []
    original = subprocess.Popen

    def remember(*arguments, **keywords):
        started.append(original(*arguments, **keywords))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", remember)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    begin = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            base.query("n(0). n(X+1) :- n(X).", time_limit=30)
        timer.join()
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - begin < 3
    assert started[0].poll() is not None
    with pytest.raises(ProcessLookupError):
        os.kill(started[0].pid, 0)


def test_limits_are_checked(base):
    with pytest.raises(UserError):
        base.query("a.", time_limit=0)
    with pytest.raises(UserError):
        base.query("a.", models=-1)
    with pytest.raises(UserError):
        base.query("a.", memory_mb=1)
