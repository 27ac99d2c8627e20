"""The rig: two cameras, their stage, and who may use them."""
