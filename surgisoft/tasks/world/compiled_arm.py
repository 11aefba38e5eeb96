"""Compiled loops of an arm of the world: the pumps in front of the model, the body behind it."""

from __future__ import annotations

import math

import numpy as np

from surgisoft.compiled import compiled


@compiled
def drive(
    command,
    pressure,
    queue,
    delay,
    gain,
    action,
    low,
    high,
    step_kPa,
    share,
    beside,
    new_command,
    new_pressure,
    new_queue,
    target,
):
    """Queue of actions, command, chamber pressure and the model's actuation after a step.

    Arrays (B, m) kPa, queue (B, D, m), delay (B,) in steps; beside (B, m) is the model's actuation
    before, target (B, m) that after. See `ModelArm._due`, `Pneumatics.command` and `follow`.
    """
    count, chambers = command.shape
    late = queue.shape[1]
    for b in range(count):
        for m in range(chambers):
            place = late - delay[b]
            due = action[b, m] if place == late else queue[b, place, m]
            for d in range(late):
                new_queue[b, d, m] = queue[b, d + 1, m] if d + 1 < late else action[b, m]
            change = min(max(due, -step_kPa), step_kPa)
            held = min(max(command[b, m] + change, low[m]), high[m])
            new_command[b, m] = held
            inside = pressure[b, m] + share * (held - pressure[b, m])
            new_pressure[b, m] = inside
            target[b, m] = beside[b, m] + (gain[b, m] * inside - beside[b, m])


@compiled
def place(points, mounts, out):
    """Key points (B, n, 3) mm from the base frame by mounts (B, 4, 4), into out (B, n, 3)."""
    for b in range(len(points)):
        t = mounts[b]
        for k in range(points.shape[1]):
            x, y, z = points[b, k, 0], points[b, k, 1], points[b, k, 2]
            for i in range(3):
                out[b, k, i] = t[i, 0] * x + t[i, 1] * y + t[i, 2] * z + t[i, 3]


@compiled
def draw_body(points, mounts, shaft, position, tangent, line, direction):
    """Centreline and tip direction of key points (B, n, 3) mm, world frame.

    position (K, n) and tangent (n,) are the backbone's; shaft (S, 3) mm, base frame, comes first
    in the line (B, S + K, 3). Fills direction (B, 3) with unit vectors.
    """
    count, keys, _ = points.shape
    ahead, samples = len(shaft), len(position)
    for b in range(count):
        t = mounts[b]
        for s in range(ahead):
            for i in range(3):
                total = t[i, 0] * shaft[s, 0] + t[i, 1] * shaft[s, 1] + t[i, 2] * shaft[s, 2]
                line[b, s, i] = total + t[i, 3]
        for k in range(samples):
            x = y = z = np.float32(0.0)
            for n in range(keys):
                x += position[k, n] * points[b, n, 0]
                y += position[k, n] * points[b, n, 1]
                z += position[k, n] * points[b, n, 2]
            line[b, ahead + k, 0], line[b, ahead + k, 1], line[b, ahead + k, 2] = x, y, z
        x = y = z = np.float32(0.0)
        for n in range(keys):
            x += tangent[n] * points[b, n, 0]
            y += tangent[n] * points[b, n, 1]
            z += tangent[n] * points[b, n, 2]
        length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
        direction[b, 0], direction[b, 1], direction[b, 2] = x / length, y / length, z / length


@compiled
def draw_arc(points, mounts, shaft, share, straight, least, line, direction):
    """Centreline and tip direction of arms with one key point (B, 1, 3) mm, world frame.

    share (K,): places on the arc; straight (rad) and least: see `ArcBackbone`, whose formula this
    is; the other arrays are those of `draw_body`.
    """
    ahead, zero = len(shaft), np.float32(0.0)
    one, two = np.float32(1.0), np.float32(2.0)
    chord = np.empty(3, np.float32)
    for b in range(len(points)):
        t = mounts[b]
        for s in range(ahead):
            for i in range(3):
                total = t[i, 0] * shaft[s, 0] + t[i, 1] * shaft[s, 1] + t[i, 2] * shaft[s, 2]
                line[b, s, i] = total + t[i, 3]
        square = along = aside = zero
        for i in range(3):
            chord[i] = points[b, 0, i] - t[i, 3]
            square += chord[i] * chord[i]
            along += chord[i] * t[i, 2]
        for i in range(3):
            off = chord[i] - along * t[i, 2]
            aside += off * off
        length = np.float32(math.sqrt(square))
        ratio = np.float32(math.sqrt(aside)) / max(length + along, np.float32(1e-12))
        angle = two * np.float32(math.atan(ratio))
        sine = max(np.float32(math.sin(angle)), np.float32(least))
        for k in range(len(share)):
            done, left = share[k], one - share[k]
            if angle >= straight:
                done = np.float32(math.sin(done * angle)) / sine
                left = np.float32(math.sin(left * angle)) / sine
            for i in range(3):
                bent = length * done * left * t[i, 2] + done * done * chord[i]
                line[b, ahead + k, i] = t[i, 3] + bent
        cosine = along / max(square, np.float32(1e-24))
        for i in range(3):
            direction[b, i] = two * cosine * chord[i] - t[i, 2]
