"""A fuzz campaign: spoilt examples of every format that is read, each in a process with limits.

    PYTHONPATH=tools .venv/bin/python -m fuzz --count 10000 --seed 0

A reader may read an input or refuse it with a `SightlineError`. Whatever else happens is a finding:
a traceback, a crash, a hang, a process that grows beyond its limit, a program or a network that is
asked for.
"""
