"""Skins behind the protocol `SkinStepper`: finite elements, and the tier for real time."""
