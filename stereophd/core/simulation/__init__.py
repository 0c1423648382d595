"""Simulated scenes as arrays: objects that move, cameras that detect them, clutter.

`timing` computes when frames are taken, `drawing` draws objects, `objects` moves them, `detections` turns them
into the frames of a log. Nothing here knows configs or files: `stereophd.commands.simulate` does.
"""
