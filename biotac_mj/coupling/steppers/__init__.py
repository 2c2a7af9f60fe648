"""Skins behind the protocol `SkinStepper`: finite elements, and the fast tier."""
