"""The command `linkax inspect FILE`: what a machine is, how it can move, and what was left out."""

import argparse
import json
from typing import Any

import linkax as lx
from linkax.cli.machine_scene import machine_scene
from linkax.cli.options import AtInterrupt, end_progress, loaded, progress
from linkax.tables import numbers


def run_inspect(arguments: argparse.Namespace, at_interrupt: AtInterrupt) -> int:
    """Load a machine, close its loops, print what it is, and return the exit code."""
    machine = loaded(arguments)
    scene = machine_scene(machine, arguments.variant)
    mechanism = scene.mechanism(scene.settings(arguments.variant))
    progress("assembling", None)
    state = scene.initial(mechanism, {})
    progress("counting degrees of freedom", None)
    mobility = lx.mobility(mechanism, state)
    violation = lx.Solution.of_state(mechanism, state).worst_violation()
    end_progress()
    topology = mechanism.topology
    described: dict[str, Any] = {
        "machine": machine.name,
        "file": str(machine.path),
        "bodies": len(machine.bodies),
        "joints": len(machine.joints),
        "mass": float(sum(float(body.arguments["mass"]) for body in machine.bodies)),
        "loops": topology.num_cuts,
        "degrees_of_freedom": int(mobility.degrees_of_freedom),
        "redundant_rows": int(mobility.num_redundant),
        "singularity_distance": float(mobility.distance),
        "position_violation": float(violation.position),
        "starts": list(machine.starts),
        "left_out": [{"line": i.where.line, "kind": i.kind, "what": str(i)} for i in machine.left_out],
    }
    print(
        json.dumps(described, allow_nan=False)
        if arguments.json
        else _for_people(described, machine, mechanism, mobility)
    )
    return 0


def _for_people(described, machine, mechanism, mobility) -> str:
    tree = [f"  {line}" for line in mechanism.topology.describe().splitlines()]
    redundant = [f"  {name}: {', '.join(rows)}" for name, rows in mobility.redundant.items()]
    left_out = [f"  {item}" for item in machine.left_out]
    lines = [
        f"{machine.name} from {machine.path}: {described['bodies']} bodies, {numbers(described['mass'], 'kg')}",
        f"  loops                 {described['loops']}",
        f"  degrees of freedom    {described['degrees_of_freedom']}",
        f"  redundant rows        {described['redundant_rows']}",
        f"  distance              {described['singularity_distance']:.3g} from a singular configuration (1 is far)",
        f"  loops closed to       {described['position_violation']:.1e} of their length",
        *([f"  starts                {', '.join(machine.starts)}"] if machine.starts else []),
        "tree, cut joints and rows of constraints:",
        *tree,
        *(["rows of which one could be left out:", *redundant] if redundant else []),
        *(["left out:", *left_out] if left_out else []),
    ]
    return "\n".join(lines)
