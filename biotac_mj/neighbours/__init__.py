"""Sensor classes with the interfaces of other frameworks: `mjlab` inside mujoco_warp's step, `isaaclab`
beside any physics that tells poses. Neither needs the framework."""

__all__ = ["isaaclab", "mjlab"]
