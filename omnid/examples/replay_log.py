"""A recorded log becomes a trajectory and a map: `python -m omnid.examples.replay_log LOG.mcap [RIG.toml]`."""

import sys

import omnid

if len(sys.argv) not in (2, 3):
    sys.exit(__doc__)
_, log, *rig = sys.argv
result = omnid.replay(log, rig=next(iter(rig), None))
for warning in result.warnings:
    print("warning:", warning, file=sys.stderr)
print(f"{len(result.stamps_ns)} poses, {result.counters.length_m:.2f} m")
result.save_tum("trajectory.tum")
result.save_ply("map.ply")
