"""Extraction of a run whose network is no table (the `paper` architecture), and from its experience alone."""

import numpy as np
import pytest

from nesy.config import CollectConfig, ExtractConfig
from nesy.dbn.codebook import Codebook
from nesy.dbn.learning.extraction import extract_run
from nesy.dbn.model import TwoSliceDBN
from nesy.run_folder import RunFolder, write_json


@pytest.fixture(scope="module")
def paper_run(tmp_path_factory):
    """Little experience, and a network of the paper's architecture as it is before training."""
    import torch

    from domains.core import load_domain
    from nesy.log.collection import collect
    from nesy.world_model.paper import PaperWorldModel
    from nesy.world_model.storage import save_world_model

    run = RunFolder(tmp_path_factory.mktemp("paper") / "run")
    settings = CollectConfig(crossing_episodes=6, following_episodes=2, shard_episodes=10, num_envs=8)
    collect(load_domain(), settings, run.experience, variant="paper", seed=0)
    torch.manual_seed(0)
    save_world_model(PaperWorldModel().eval(), run.world_model, {})
    write_json(run.config, {"seed": 3})
    return run


def test_a_network_that_is_no_table_is_extracted(paper_run):
    figures = extract_run(paper_run, "person_following")
    dbn, codebook = TwoSliceDBN.load(paper_run.dbn), Codebook.load(paper_run.dbn)
    assert dbn.provenance["architecture"] == "paper" and dbn.provenance["seed"] == 3
    assert figures["nll"] > 0 and 0 <= figures["max_difference_to_network"] <= 1
    assert {"observation", "reward", "termination"} <= dbn.step_tables.keys()
    assert len(dbn.tables["codes"]) == len(np.unique(codebook.codes, axis=0)) == figures["codes_met"]
    assert max(len(ps) for per_action in dbn.parents_now for ps in per_action) <= 4


def test_parents_of_the_network_by_other_scores(paper_run):
    extract_run(paper_run, "person_following", ExtractConfig(score="bic", max_parents=1))
    assert max(len(ps) for per_action in TwoSliceDBN.load(paper_run.dbn).parents_now for ps in per_action) <= 1


def test_tables_are_counted_from_experience_alone(paper_run):
    figures = extract_run(paper_run, "person_following", ExtractConfig(source="experience", prior_count=0.5))
    dbn = TwoSliceDBN.load(paper_run.dbn)
    assert dbn.provenance["source"] == "experience" and "max_difference_to_network" not in figures
    # with a prior nothing that the factor ever does is impossible
    assert figures["impossible"] == 0 and figures["nll"] >= figures["nll_limit"]
