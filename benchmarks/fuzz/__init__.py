"""Fuzzing of every reader: mutated files must end in a value or in one line.

`python -m benchmarks.fuzz --seconds 600` makes valid files with the project itself, mutates them
and reads each with a limit on memory and processor time. A finding is an exception other than
`InputError`, a message of several lines or without bound, a hang, too much memory, or a crash.
"""
