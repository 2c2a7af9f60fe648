"""Which packages there are; all else is in pyproject.toml."""

from setuptools import find_packages, setup

# The model, the meshes and the engine plugin lie at the top of the repository, where people look for them,
# and ship inside the package.
AT_THE_TOP = {"biotac_mj.plugin": "plugin", "biotac_mj.mjcf": "mjcf", "biotac_mj.assets": "assets"}

setup(
    packages=sorted({*find_packages(include=["biotac_mj", "biotac_mj.*"]), *AT_THE_TOP}),
    package_dir={"biotac_mj": "biotac_mj", **AT_THE_TOP},
)
