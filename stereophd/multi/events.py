"""Cameras and events, as the multi-object filters name them (see `stereophd.disparity.events`)."""

from stereophd.disparity.events import Event, Rig, make_event, make_rig

__all__ = ["Event", "Rig", "make_event", "make_rig"]
