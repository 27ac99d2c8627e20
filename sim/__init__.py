"""A simulated rig: scenes, renderer, cameras and stage controllers."""
