"""The skins of the package as `SkinStepper`s: finite elements, and the fast tier."""
