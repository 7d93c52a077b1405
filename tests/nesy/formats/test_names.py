"""Names in files for other programs: any names, and each of them known again."""

import csv
import re

import clingo
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from nesy import formats
from nesy.asp import KnowledgeBase
from nesy.asp.program import names as asp_names
from nesy.dbn.codebook import Codebook
from nesy.dbn.model import TwoSliceDBN
from nesy.errors import UserError
from nesy.formats import bayes_nodes, bif, csv_table, dot, graphml, jgum, parquet, pddl, prism, rddl
from nesy.formats.programs.agreement import by_pyagrum, by_storm, own
from nesy.names import ASCII, TEXT
from tests.nesy.dbn.models import random_dbn, transition_matrix
from tests.nesy.dbn.steps import with_steps
from tests.nesy.dbn.test_storage import same

NASTY = (
    *("go left", "go-left", "go_left", "go__left", "go_", "_go", "Go", "GO", "go", "", " ", "_", "__", "3", "3x", "0"),
    *("init", "true", "A", "x0", "y1", "step", "done", "view", "factor_x0", "network", "not", "and", "arrive", "a/b"),
    *("forward", "forward_1", "forward_end", "forward__1", "forward__end", "forward_x5fend", "do_go", "cell_0_0"),
    *("go_x20left", "n_x20", "n_empty", "n", "x'", "x", "x''", "a=1 b", 'say "no"', "a\\", "check(3)", "a-1", "a-1-1"),
    *(
        "größe",
        "Größe",
        "\u00a0",
        "\u201cgo\u201d",
        "前へ",
        "\U0001f600",
        "a\nb",
        "a\r",
        "a\tb",
        "\0",
        "&lt;",
        "<b>",
        "%x",
    ),
    *("X0", "X0'", "X1", "a;b", "a,b", "{a}", "[2]", "// a", "*/", "@v0", "?v", "*%", "\ufeffa", "e\u0301", "\u00e9"),
)
NAMES = st.one_of(
    st.text(max_size=12),
    st.sampled_from(NASTY),
    st.from_regex(r"\A_{0,2}(n|do|x|N)?_[xuw][0-9a-f]{0,7}_?(end|1)?\Z"),
    st.builds(str.__add__, st.sampled_from(NASTY), st.sampled_from(NASTY)),
)
SEVERAL = st.lists(NAMES, min_size=2, max_size=4, unique=True)
# what each program takes as a name, written down apart from the grammars
FORMS = {
    "prism": (prism.NAMES, r"[A-Za-z_][A-Za-z0-9_]*"),
    "rddl": (rddl.NAMES, r"do_[A-Za-z0-9](_?[A-Za-z0-9])*"),
    "pddl": (pddl.NAMES, r"[a-z][a-z0-9_]*"),
    "bif": (bif.NAMES, r"[A-Za-z][A-Za-z0-9_]*"),
    "jgum": (jgum.NAMES, r"[A-Za-z][A-Za-z0-9_]*"),
    "csv": (csv_table.NAMES, r"[^\s=]+"),
    "parquet": (parquet.NAMES, r".+"),
    "dot": (dot.NAMES, r".+"),
    "graphml": (graphml.NAMES, r".+"),
    "asp": (asp_names, r'[a-z_][A-Za-z0-9_]*|"([^"\\]|\\.)*"'),
}


def model(actions, factors=("X0", "X1"), later=True, seed=0, steps=False):
    rng = np.random.default_rng(seed)
    n = len(factors)
    tables = [[rng.dirichlet([1, 1], 8 if later and i == 1 else 4) for i in range(n)] for _ in actions]
    dbn = TwoSliceDBN.from_tables(
        tables,
        [[[0, 1]] * n for _ in actions],
        [[[0] if later and i == 1 else [] for i in range(n)] for _ in actions],
        action_names=actions,
        factor_names=factors,
        counts=[[np.ones(len(t), int) for t in ts] for ts in tables],
    )
    return with_steps(dbn, rng) if steps else dbn


@pytest.mark.parametrize("kind", FORMS)
@settings(max_examples=300, deadline=None)
@given(first=NAMES, second=NAMES)
@example("go left", "go-left")
@example("n_x20", " ")
@example("", "n_empty")
def test_names_differ_are_taken_and_are_known_again(kind, first, second):
    grammar, form = FORMS[kind]
    written = [grammar.encode(name) for name in (first, second)]
    assert (written[0] == written[1]) == (first == second)
    for name, text in zip((first, second), written, strict=True):
        assert re.fullmatch(form, text), text
        assert text not in getattr(grammar, "reserved", ()) and text.splitlines() == [text]
        assert formats.name_of(kind, text) == name
    if kind == "prism":
        assert "__" not in written[0] and not written[0].endswith("_")
        assert formats.name_of(kind, written[0] + "__end") == formats.name_of(kind, written[0] + "__12") == first
    if kind == "pddl":
        assert formats.name_of(kind, f"{written[0]}-17") == formats.name_of(kind, f"{written[0]}-17-1") == first
    if kind in ("bif", "jgum"):
        assert formats.name_of(kind, f"{written[0]}__{written[1]}") == first
    if kind in ("csv", "parquet", "dot", "graphml"):
        assert not written[0].endswith("'") and formats.name_of(kind, written[0] + "'") == first


@pytest.mark.parametrize("kind", FORMS)
@pytest.mark.parametrize("name", ["left", "forward", "stay", "go_left", "X0", "turn2", "wall_ahead"])
def test_ordinary_names_stay_as_they_are(kind, name):
    grammar = FORMS[kind][0]
    if kind == "pddl" and name == "X0":
        assert grammar.encode(name) == "n_x580"
    elif kind == "asp" and name == "X0":
        assert grammar.encode(name) == '"X0"'
    else:
        assert grammar.encode(name) == {"rddl": "do_"}.get(kind, "") + name


def export_again(kind, actions, factors, folder, **options):
    path = folder / f"m{formats.FORMATS[kind].suffix}"
    dbn = model(actions, factors, steps=True)
    formats.export(dbn, path, format=kind, **options)
    return dbn, path


@pytest.mark.parametrize("kind", ["native", "parquet", "jgum"])
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(actions=SEVERAL, factors=SEVERAL)
def test_files_that_are_read_back_keep_the_names(kind, actions, factors, tmp_path_factory):
    dbn, path = export_again(kind, actions, factors, tmp_path_factory.mktemp("names"))
    assert same(formats.read(path, format=kind), dbn)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(actions=SEVERAL, factors=SEVERAL)
def test_every_node_of_a_bayesian_network_has_a_name_of_its_own(actions, factors):
    nodes = list(bayes_nodes.nodes(model(actions, factors, steps=True)))
    assert len({node.name for node in nodes}) == len(nodes) == len(factors) * (1 + len(actions)) + 2 + len(actions)


def test_a_cell_that_is_called_like_a_factor():
    nodes = [node.name for node in bayes_nodes.nodes(model(("go",), ("cell_0_0", "view"), steps=True))]
    assert nodes == ["cell_0_0", "n_x76iew", "cell_0_0__go", "n_x76iew__go", "view__cell_0_0", "cell_0_1", "done__go"]


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(actions=SEVERAL, factors=SEVERAL)
def test_tables_and_graphs_hold_the_names(actions, factors, tmp_path_factory):
    import networkx

    pydot = pytest.importorskip("pydot")
    folder = tmp_path_factory.mktemp("names")
    dbn, path = export_again("csv", actions, factors, folder)
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(dict.fromkeys(TEXT.decode(row["action"]) for row in rows)) == list(actions)
    assert list(dict.fromkeys(TEXT.decode(row["factor"]) for row in rows)) == list(factors)
    parents = [p.rsplit("=", 1)[0] for p in rows[-1]["parents"].split(" ")]
    wanted = dbn.parents(len(actions) - 1, len(factors) - 1)
    assert [(int(p.endswith("'")), formats.name_of("csv", p)) for p in parents] == [(s, factors[p]) for s, p in wanted]

    _, path = export_again("parquet", actions, factors, folder)
    row = pq.read_table(path).slice(len(rows) - 1, 1).to_pylist()[0]
    assert (row["action"], row["factor"]) == (actions[-1], factors[-1])
    assert [formats.name_of("parquet", p) for p in row["parents"]] == [factors[p] for _, p in wanted]

    _, path = export_again("graphml", actions, factors, folder)
    graph = networkx.read_graphml(path, force_multigraph=True)
    arcs = sum(len(dbn.parents(a, i)) for a in range(len(actions)) for i in range(len(factors)))
    assert len(graph) == 2 * len(factors) and graph.number_of_edges() == arcs
    assert {formats.name_of("graphml", node) for node in graph} == set(factors)
    assert {TEXT.decode(data["action"]) for *_, data in graph.edges(data=True)} == set(actions)

    _, path = export_again("dot", actions, factors, folder)
    parts = pydot.graph_from_dot_file(str(path), encoding="utf-8")[0].get_subgraphs()
    labels = [[plain(node.get_label()) for node in part.get_nodes() if node.get_label()] for part in parts]
    assert [{formats.name_of("dot", label) for label in found} for found in labels] == [set(factors)] * len(actions)
    assert [TEXT.decode(plain(part.get_label())) for part in parts] == list(actions)


def plain(label):
    return re.sub(r"\\(.)", r"\1", label[1:-1]).replace("&amp;", "&")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(actions=SEVERAL, factors=SEVERAL)
def test_clingo_finds_every_action(actions, factors, tmp_path_factory):
    _, path = export_again("asp", actions, factors, tmp_path_factory.mktemp("names"))
    control = clingo.Control()
    control.load(str(path))
    control.ground([("base", [])])
    found = [str(atom.symbol.arguments[0]) for atom in control.symbolic_atoms.by_signature("action", 1)]
    assert {asp_names.decode(term) for term in found} == set(actions) and len(found) == len(actions)
    text = path.read_text(encoding="utf-8")
    kept = [ASCII.decode(line.split(": ", 1)[1]) for line in text.split("\n") if line.startswith("% factor ")]
    assert kept == list(factors)


def test_lone_surrogates_are_no_names():
    with pytest.raises(UserError, match="lone surrogates"):
        model(("a", "\ud800"))
    with pytest.raises(UserError, match="has text as its name"):
        model(("a", 1))


BOOK = ("Is high", "not", "größe", 'say "no"', "a,b", "tall")


def base_with(actions, factors=("X0", "X1"), predicates=BOOK):
    rng = np.random.default_rng(3)
    codes = np.array(list(np.ndindex(2, 2)), dtype=np.uint8)
    truth = rng.random((4, len(predicates))) < 0.5
    truth[:, 0] = codes[:, 0] == 1
    book = Codebook(
        views=codes[:, None],
        codes=codes,
        counts=np.ones(4, np.int64),
        predicates=truth,
        predicate_names=tuple(predicates),
        predicate_meanings=("",) * len(predicates),
        cell_kinds=("Free", "free"),
    )
    return KnowledgeBase(model(actions, factors), book)


def test_questions_are_asked_about_any_names():
    base = base_with(("Go left", "go left", "not"), ("Row A", "row a"))
    assert base.query("n(C) :- C = #count { A : action(A) }. #show n/1.").models == (("n(3)",),)
    assert base.query("n(C) :- C = #count { T : cell(_,_,_,T) }. #show n/1.").models == (("n(2)",),)
    assert base.query('found(I) :- holds(I,"Is high"). #show found/1.').models == (("found(2)", "found(3)"),)
    assert "Row A = 1: true in 2 of 2" in base.implies("Is high").text
    assert base.rules("Is high").rows[0]["asp"] == 'now("Is high") :- at(0,1).'
    assert base.verify("Go left", "Is high", "not tall, Row A != 1").rows[0]["holds"] is False
    assert base.verify("Go left", "not", "not not").rows
    assert base.knows(base.codebook.codes[2:3], ["Is high"]).rows[0]["knows"]
    model_, report = base.constrained(['impossible("Go left",0,X,1) :- row("Go left",0,X,1,_).'])
    assert report.entries == 4 and (model_.cpt(0, 0)[:, 1] == 0).all() and (model_.cpt(1, 0)[:, 1] > 0).all()
    rules = ['forbidden("Go left") :- now("Is high"). preferred("not").']
    found = base.allowed(rules, [1, 0])
    assert found.rows[0]["allowed"] == ["go left", "not"] and found.rows[0]["preferred"] == ["not"]
    assert base.allowed(rules, [0, 0]).rows[0]["allowed"] == ["Go left", "go left", "not"]
    with pytest.raises(UserError, match='no such action; the actions are "Go left"'):
        base.allowed(["forbidden(go_left) :- now(tall)."], [0, 0])
    plan = base.plan([0, 0], "Is high", rules=[':- do("go left",T).'])
    assert "go left" not in (plan.rows[0]["actions"] or ())
    assert base.facts.vocabulary()["action(A)"] == 'A is an action: "Go left", "go left", "not"'


def test_all_facts_can_be_written_without_a_codebook_and_without_predicates():
    dbn = random_dbn(np.random.default_rng(0))
    book = Codebook.build(np.zeros((2, 1, 1), int), np.array([[0, 0, 0], [1, 1, 1]]), np.ones(2), None)
    for base in (KnowledgeBase(dbn), KnowledgeBase(dbn, book)):
        text = base.facts.text(base.facts.names)
        assert "factor(0..2)." in text and "together" not in text
        assert base.query("a.", rules=[text]).satisfiable


@pytest.mark.check
class TestOtherPrograms:
    """All nasty names at once, as actions and as factors, in the programs that the files are for."""

    @pytest.mark.parametrize("later", [False, True])
    def test_storm_finds_every_action(self, tmp_path, later):
        stormpy = pytest.importorskip("stormpy")
        formats.export(model(NASTY, later=later), tmp_path / "m.prism")
        program = stormpy.parse_prism_program(str(tmp_path / "m.prism"))
        options = stormpy.BuilderOptions()
        options.set_build_choice_labels()
        found = stormpy.build_model(program, options=options)
        first = found.initial_states[0]
        choices = range(found.get_nr_available_actions(first))
        assert len(choices) == len(NASTY)
        labels = [found.choice_labeling.get_labels_of_choice(found.get_choice_index(first, c)) for c in choices]
        assert {formats.name_of("prism", next(iter(label))) for label in labels} == set(NASTY)
        names = [
            line[3:].split(": ", 1) for line in (tmp_path / "m.prism").read_text().split("\n") if line[:3] == "// "
        ]
        assert [ASCII.decode(name) for _, name in names] == ["X0", "X1", *NASTY]
        assert [formats.name_of("prism", written) for written, _ in names[2:]] == list(NASTY)

    @pytest.mark.parametrize("seed", range(4))
    def test_probabilities_are_those_of_our_own_inference(self, seed):
        pytest.importorskip("stormpy")
        pytest.importorskip("pyagrum")
        rng = np.random.default_rng(seed)
        names = rng.permutation(np.array([*NASTY, "go_1"], dtype=object)).tolist()
        dbn = model(
            ["go", "go__1", "go_1", "forward", "forward_end", *names[:3]][: 5 + seed], tuple(names[-2:]), seed=seed
        )
        plan, goal = rng.integers(dbn.num_actions, size=4).tolist(), {1: 1}
        mine = own(dbn, np.array([0, 1]), plan, goal)
        assert by_storm(dbn, np.array([0, 1]), plan, goal) == pytest.approx(mine, abs=1e-9)
        assert by_pyagrum(dbn, np.array([0, 1]), plan, goal) == pytest.approx(mine, abs=1e-9)

    def test_storm_finds_the_best_policy_among_actions_that_are_called_like_links_of_a_chain(self, tmp_path):
        stormpy = pytest.importorskip("stormpy")
        for seed, names in enumerate((["go", "go_1"], ["go", "go__1", "go__end"], ["go", "go_end", "GO"])):
            dbn = model(names, seed=seed)
            formats.export(dbn, tmp_path / "m.prism", start=np.array([0, 0]))
            program = stormpy.parse_prism_program(str(tmp_path / "m.prism"))
            # six rounds of three moves, and the phase that closes them
            properties = stormpy.parse_properties("Pmax=? [F<=18 (x0=1 & x1=1 & phase=0)]", program)
            found = stormpy.build_model(program, properties)
            most = [transition_matrix(dbn, a) for a in range(dbn.num_actions)]
            value = np.array([0, 0, 0, 1.0])
            for _ in range(6):
                value = np.max([matrix @ value for matrix in most], axis=0)
                value[3] = 1.0
            result = stormpy.model_checking(found, properties[0]).get_value(found.initial_states[0])
            assert result == pytest.approx(value[0], abs=1e-9)

    @pytest.mark.parametrize("later", [False, True])
    def test_pyrddlgym_finds_every_action(self, tmp_path, later):
        pyrddlgym = pytest.importorskip("pyRDDLGym")
        formats.export(model(NASTY, tuple(NASTY[:3]), later), tmp_path / "m.rddl")
        environment = pyrddlgym.make(str(tmp_path / "m.rddl"), str(tmp_path / "m_instance.rddl"))
        names = list(environment.action_space.spaces)
        assert {formats.name_of("rddl", name) for name in names} == set(NASTY) and len(names) == len(NASTY)
        environment.reset(seed=0)
        environment.step({names[0]: True})

    def test_the_pddl_reader_finds_every_action(self, tmp_path):
        reader = pytest.importorskip("unified_planning.io")
        dbn = model(NASTY, ("Row", "row"), later=False)
        formats.export(dbn, tmp_path / "m.pddl", goal={0: 1})
        problem = reader.PDDLReader().parse_problem(str(tmp_path / "m.pddl"), str(tmp_path / "m_problem.pddl"))
        found = [action.name for action in problem.actions]
        assert len({name.lower() for name in found}) == len(found)
        assert {formats.name_of("pddl", name) for name in found} == set(NASTY)
        assert {pddl.action_of(dbn, f"({name.upper()} )") for name in found} == set(range(len(NASTY)))

    def test_an_action_called_arrive_is_no_end_of_a_plan(self, tmp_path):
        pytest.importorskip("up_fast_downward")
        from nesy.formats.programs.execution import by_fast_downward

        dbn = model(("arrive", "Arrive"), later=False, seed=1)
        plan = by_fast_downward(dbn, np.array([0, 0]), np.array([[1, 1]]), outcomes=4)
        assert plan and plan[-1][1] == (1, 1) and pddl.action_of(dbn, "(arrive-0)") is None

    @pytest.mark.parametrize("kind", ["bif", "jgum"])
    def test_pyagrum_reads_every_node(self, tmp_path, kind):
        gum = pytest.importorskip("pyagrum")
        actions, factors = NASTY[::3], NASTY[1::5]
        dbn, path = export_again(kind, actions, factors, tmp_path)
        network = gum.loadBN(str(path))
        now, later = bayes_nodes.node_names(dbn)
        assert set(network.names()) == {node.name for node in bayes_nodes.nodes(dbn)}
        assert [formats.name_of(kind, name) for name in now] == list(factors)
        table = network.cpt(later[2][0])
        array = np.asarray(table.toarray()).transpose(
            [list(reversed(table.names)).index(name) for name in (now[0], now[1], later[2][0])]
        )
        np.testing.assert_allclose(array, dbn.tensor(2, 0), rtol=0, atol=1e-7)
