"""Rule files are text from strangers: nothing runs, nothing hangs, each gets one clear line."""

import os
import time

import pytest

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
    "deep term": ("p(" + "f(" * 50_000 + "a" + ")" * 50_000 + ").", None),
    "deep negation": ("p :- " + "not " * 3 + "q.", "syntax error"),
    "externals": ("#external p(1..3). a :- p(1).", None),
    "an external that is unsafe": ("#external p(X) : not q(X).", "unsafe"),
    "another program part": ("#program step(t). p(t). n(0). n(X+1) :- n(X).", None),
    "the base part with parameters": ("#program base(x). p(x).", None),
    "an edge into the solver": ("#edge (X,X) : X = 1..3.", None),
    "a heuristic": ("{ a }. #heuristic a. [1,true]", None),
    "projection of everything": ("{ a(1..40) }. #project a/1.", None),
    "a huge file": ("p(1). " * 2_000_000, "longer than"),
    "wrong bytes": (b"caf\xe9(1).", ":1: not UTF-8"),
    "utf-16": ("a.".encode("utf-16"), "not UTF-8"),
    "nul": (b"a.\n\0b.", ":2: holds a NUL"),
    "binary": (bytes(range(1, 256)), "(UTF-8|error)"),
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
        assert str(path) in text or "solver ended" in text or "MB" in text
        if message:
            import re

            assert re.search(message, text), text
    else:
        assert name not in MUST_FAIL, answer
    assert time.monotonic() - started < LIMIT + 1.5
    assert not marker.exists()


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
