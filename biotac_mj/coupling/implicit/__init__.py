"""The implicit step: forces of BioTacs and the motion of their bodies, found together.

`rounds`, `energy` and `rules` are the step itself, of one world or of many: Warp kernels and functions.
`world` calls them for all BioTacs of one mjData, with what MuJoCo gives; `batch` with what mujoco_warp
gives."""
