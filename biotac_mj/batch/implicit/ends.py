"""Predicts the poses to which the integrator will move the bodies of a batch. Joints move along arcs, while
the skin is solved along straight lines. mujoco_warp's own kernels find these poses before it integrates,
since it has no callback after that."""

import copy
import typing

import warp as wp

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

# what mujoco_warp's kinematics writes
_POSES = "xpos xquat xmat xanchor xaxis xipos ximat geom_xpos geom_xmat site_xpos site_xmat".split()


class Ends:
    """Poses of the bodies of a mujoco_warp Data after the step that it is in."""

    def __init__(self, d: "mjw.Data"):
        # kinematics leaves what never moves as it is
        self._own = {name: wp.clone(getattr(d, name)) for name in ("qpos", "qvel", *_POSES)}

    def find(self, m: "mjw.Model", d: "mjw.Data", qacc: wp.array) -> "mjw.Data":
        """`d` after a step with the integrator's accelerations (nworld, nv), as far as velocities and poses.
        Launches only."""
        import mujoco_warp as mjw
        from mujoco_warp._src import forward

        end, step, device = copy.copy(d), m.opt.timestep, d.qpos.device
        for name, array in self._own.items():
            setattr(end, name, array)
        wp.launch(
            forward._next_velocity,
            dim=d.qvel.shape,
            inputs=[step, d.qvel, qacc, 1.0],
            outputs=[end.qvel],
            device=device,
        )
        joints = [m.jnt_type, m.jnt_qposadr, m.jnt_dofadr]
        wp.launch(
            forward._next_position,
            dim=(d.nworld, m.njnt),
            inputs=[step, *joints, d.qpos, end.qvel, 1.0],
            outputs=[end.qpos],
            device=device,
        )
        mjw.kinematics(m, end)
        return end
