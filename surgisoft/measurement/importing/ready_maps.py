"""Maps that come with the package, by name."""

_MOTIVE = """# OptiTrack Motive's CSV export and the log of the actuation, matched by time.
#
#   surgisoft import take.csv log.csv --map motive -o recording.parquet
#
# The log is a CSV table with the columns t_s, p1_kPa, p2_kPa, ... (and c1_kPa, ... where there is
# a command); its clock starts with the take's.

[file.take]
format = "motive"

[file.log]
match = "*.csv"
join = "time"             # linear interpolation between the log's rows; the command is held
clock = "from_start"      # both clocks count from their first row
max_gap_s = 1.0           # longer gaps in the log are left out

[time]
column = "Time"

[measured]
file = "log"              # every column named p1_UNIT, p2_UNIT, ...

[commanded]
file = "log"              # every column named c1_UNIT, ...
optional = true           # if there are any

[key_points]
@AUTO@

[frame]
origin = "k0"             # the first plane at rest is the base
align_z = "rest"          # z from the base to the tip at rest
gravity = [0, -1, 0]      # Motive's y points up
rest_rows = 20            # the arm rests during the first rows

[recording]
note = "OptiTrack Motive"
"""

_PLANES = """auto = "planes"           # circle fit of three or more markers a plane,
pattern = '(.+):'         # which are named PLANE:MARKER; planes in the order of their names"""

_BODIES = """auto = "bodies"           # pivot of every rigid body, in the order of their names"""

READY_MAPS = {
    "motive": _MOTIVE.replace("@AUTO@", _PLANES),
    "motive-bodies": _MOTIVE.replace("@AUTO@", _BODIES),
}
"""TOML text of each ready map."""
