"""Gradients through rubber, liquid and film (extra `learning`, which has PyTorch)."""

from .press import PARAMETERS, Pressed, press, relative_pose
from .skin import Skin

__all__ = ["PARAMETERS", "Pressed", "Skin", "press", "relative_pose"]
