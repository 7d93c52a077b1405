"""The world model: views to codes, codes to next codes, and back."""

from nesy.world_model.codec import SymbolicCodec
from nesy.world_model.distinct import Transitions, reference_transitions
from nesy.world_model.networks import SymbolicWorldModel, WorldModel
from nesy.world_model.paper import PaperWorldModel
from nesy.world_model.storage import load_world_model, save_world_model
from nesy.world_model.structure import Structure
from nesy.world_model.training.loop import train

__all__ = [
    "PaperWorldModel",
    "Structure",
    "SymbolicCodec",
    "SymbolicWorldModel",
    "Transitions",
    "WorldModel",
    "load_world_model",
    "reference_transitions",
    "save_world_model",
    "train",
]
