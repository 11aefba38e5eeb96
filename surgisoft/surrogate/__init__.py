"""The arm model: HAW-NN, effects, backbone, baselines. Knows no scene."""
