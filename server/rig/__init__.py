"""The rig: two cameras, their stage, and who may use them."""

from server.rig.rig import Rig

__all__ = ["Rig"]
