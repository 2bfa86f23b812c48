"""The verbs: fit, fit without labels, track, run and evaluate, each over the files of a scene."""
