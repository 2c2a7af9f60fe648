"""Where the integrator takes the bodies of a batch: joints go round in arcs, which predictions of the skin
leave straight. As `World._arrive` for all worlds at once, before mujoco_warp integrates, by its own kernels:
no callback comes after it."""

import copy
import typing

import warp as wp

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

__all__ = ["Ends"]

# what mujoco_warp's kinematics writes
_POSES = "xpos xquat xmat xanchor xaxis xipos ximat geom_xpos geom_xmat site_xpos site_xmat".split()


class Ends:
    """A mujoco_warp Data at the end of the step, of which only poses are known."""

    def __init__(self, d: "mjw.Data"):
        self.data = copy.copy(d)  # all else, as what poses mocap bodies, is that of the step
        for name in ("qpos", "qvel", *_POSES):
            setattr(self.data, name, wp.clone(getattr(d, name)))  # kinematics leaves the world as it is

    def find(self, m: "mjw.Model", d: "mjw.Data", qacc: wp.array) -> None:
        """Finds the poses of `data` after a step with the integrator's accelerations (nworld, nv). Launches
        only."""
        import mujoco_warp as mjw
        from mujoco_warp._src import forward

        end, step, device = self.data, m.opt.timestep, d.qpos.device
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
