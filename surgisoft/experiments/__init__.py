"""Scripted experiments on a scene: phases, cases, what varies, limits; tables, replays, a report.

`spec` is the file, `phased` the task wrapper with the interlock, `hands` who moves each arm, `plan`
what is to be played, `play` plays a block of episodes, `run` all of them, `results` sums up.
"""
