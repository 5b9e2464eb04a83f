"""Parameters of mechanisms from records of imperfect instruments: whether intervals hold the truth, and against peers.

`coverage`: a four-bar with a damped bearing and a spring; an encoder with gain, bias, delay, noise that is not known
and 5 % outliers, and a camera that tracks the coupler. A row for each parameter: how often intervals of 95 % hold the
truth, and errors.

`sysid`: three numbers of a double pendulum, and of the four-bar that it becomes when its end is held, from two
encoders, by linkax and by MuJoCo's `sysid`, whose loop is a stiff equality. Rows: the largest relative error, and
seconds; of linkax also the largest relative standard error, which noise alone explains, and the first time, when it
compiles.
"""

import contextlib
import io
import time
from collections.abc import Iterator

import diffrax
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts

SEEDS = 100
SAMPLE = 0.03  # s
TIMES = np.arange(0.09, 3.0, SAMPLE)
CAMERA = np.arange(0.1, 2.9, 0.05)  # s
NOISE = {"encoder": 0.01, "camera": 1e-3}  # rad, m
OUTLIERS, FAR = 0.05, 30.0  # share, and size in units of the noise
TRUTH = {
    "coupler_mass": 0.7,  # kg
    "damping": 0.1,  # N m s
    "stiffness": 6.0,  # N m/rad
    "angle": 1.2,  # rad
    "gain": 1.03,
    "bias": 0.05,  # rad
    "delay": 0.013,  # s
}
START = {name: lx.Positive(1.1 * TRUTH[name]) for name in ("coupler_mass", "damping", "stiffness")} | {
    "angle": 1.15,
    "gain": 1.0,
    "bias": 0.0,
    "delay": 0.0,
}


def motion(params):
    """A driven crank of known mass, a coupler, and a rocker on a spring; friction in the crank's bearing."""
    mechanism = _linkage(params, is_loop=True)
    state = lx.assemble(mechanism, {"bearing": params["angle"]}, guess={"crank_pin": -1.0, "pivot": 2.0})
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, 3.0, 121))
    return lx.simulate(mechanism, state, t1=3.0, accuracy=lx.Accuracy(1e-7), saveat=saveat)


def sensors(params):
    told = {name: params[name] for name in ("gain", "bias", "delay")}
    return {
        "encoder": lx.Encoder("bearing", **told, loss="cauchy"),
        "camera": lx.Tracker("coupler", components=(0, 1), loss="huber"),
    }


def records(seeds: int = SEEDS) -> Iterator[lx.Record]:
    """What the instruments tell, for each seed."""
    blank = {"encoder": (TIMES, 0.0 * TIMES), "camera": (CAMERA, np.zeros((len(CAMERA), 2)))}
    exact = lx.Experiment(motion, blank, sensors).predict(TRUTH)
    for seed in range(seeds):
        draw, told = np.random.default_rng(seed), {}
        for name, (ts, _) in blank.items():
            noise = draw.normal(size=exact[name].shape)
            far = draw.uniform(size=noise.shape) < OUTLIERS
            told[name] = ts, np.asarray(exact[name]) + NOISE[name] * np.where(far, FAR * noise, noise)
        yield lx.Record(told)


def coverage(seeds: int = SEEDS) -> Iterator[dict]:
    """Rows for each parameter, and for all together."""
    held, errors, noises, steps, seconds = [], [], [], [], []
    for record in records(seeds):
        began = time.perf_counter()
        found = lx.fit(lx.Experiment(motion, record, sensors), START, progress=False)
        seconds.append(time.perf_counter() - began)
        lower, upper = found.interval(0.95)
        held.append([lower[name] < value < upper[name] for name, value in TRUTH.items()])
        errors.append([found.params[name] - value for name, value in TRUTH.items()])
        assert found.noises is not None
        noises.append([np.mean(found.noises[name]) / value for name, value in NOISE.items()])
        steps.append(found.steps)
    held, errors = np.array(held), np.abs(np.array(errors))
    for column, name in enumerate(TRUTH):
        off = {"root_mean_square_error": float(np.sqrt(np.mean(errors[:, column] ** 2)))}
        yield {"parameter": name, "held": float(np.mean(held[:, column])), **off}
    delays = errors[:, list(TRUTH).index("delay")] / SAMPLE
    yield {
        "parameter": "all",
        "held": float(np.mean(held)),
        "largest_error_of_delay_in_samples": float(np.max(delays)),
        "noise_found_over_true": dict(zip(NOISE, np.mean(noises, axis=0).tolist(), strict=True)),
        "steps": float(np.median(steps)),
        "first_fit_s": seconds[0],
        "a_fit_s": float(np.median(seconds[1:] or seconds)),
    }


EXACT = {"coupler_mass": 0.7, "damping": 0.1, "stiffness": 6.0}  # kg, N m s, N m/rad
SAMPLES = np.linspace(0.0, 2.0, 201)
SMALL = 1e-4  # rad, noise
STEPS = (2e-3, 5e-4)  # s, of MuJoCo


def _linkage(params, is_loop) -> lx.Mechanism:
    crank = lx.rod("crank", length=0.3, mass=1.0)
    coupler = lx.rod("coupler", length=0.8, mass=params["coupler_mass"])
    rocker = lx.rod("rocker", length=0.6, mass=1.2)
    joints = [
        lx.Revolute("bearing", lx.GROUND, crank.at("base"), axis="z"),
        lx.Revolute("crank_pin", crank.at("tip"), coupler.at("base"), axis="z"),
        lx.Revolute("pivot", lx.GROUND.at([0.9, 0.0, 0.0]), rocker.at("base"), axis="z"),
        lx.Revolute("rocker_pin", coupler.at("tip"), rocker.at("tip"), axis="z", cut=True),
    ]
    spring = lx.JointSpring("pivot" if is_loop else "crank_pin", params["stiffness"], free=2.4 if is_loop else -1.0)
    forces = [
        lx.Gravity([0.0, -9.81, 0.0]),
        lx.JointDamper("bearing", params["damping"]),
        lx.JointTorque("bearing", 0.5),
    ]
    if is_loop:
        return lx.Mechanism([crank, coupler, rocker], joints, [*forces, spring])
    return lx.Mechanism([crank, coupler], joints[:2], [*forces, spring])


def _state(params, is_loop) -> lx.State:
    """Where it starts, whatever the parameters."""
    guess = {"crank_pin": -1.0, "pivot": 2.0}
    mechanism = _linkage(params, is_loop)
    return (
        lx.assemble(mechanism, {"bearing": 1.2}, guess=guess)
        if is_loop
        else lx.State(np.array([1.2, -1.0]), np.zeros(2))
    )


def sysid() -> Iterator[dict]:
    """Both, on the same records from the same start."""
    for is_loop in (False, True):
        state = _state(EXACT, is_loop)
        columns = _linkage(EXACT, is_loop).topology.coordinates
        angles = {name: float(np.asarray(state.q)[places][0]) for name, places in columns.items()}
        joints = ("bearing", "pivot" if is_loop else "crank_pin")

        def run(params, rtol=1e-7, is_loop=is_loop, state=state):
            saveat = diffrax.SaveAt(ts=np.linspace(0.0, 2.0, 81))
            return lx.simulate(_linkage(params, is_loop), state, t1=2.0, accuracy=lx.Accuracy(rtol), saveat=saveat)

        precise = run(EXACT, 1e-11).at(SAMPLES)
        draw = np.random.default_rng(0)
        told = {name: np.asarray(precise.joint(name)) + SMALL * draw.normal(size=len(SAMPLES)) for name in joints}
        start = {name: 1.3 * value for name, value in EXACT.items()}
        record = {name: (SAMPLES, values) for name, values in told.items()}
        experiment = lx.Experiment(run, record, {name: lx.Encoder(name, noise=SMALL) for name in joints})
        seconds = []
        for _ in range(3):
            began = time.perf_counter()
            found = lx.fit(experiment, {name: lx.Positive(value) for name, value in start.items()}, progress=False)
            seconds.append(time.perf_counter() - began)
        of = {"mechanism": "four-bar" if is_loop else "double pendulum"}
        off = lambda params: max(abs(float(params[name]) / value - 1.0) for name, value in EXACT.items())
        expected = max(float(found.standard_errors[name]) / value for name, value in EXACT.items())
        ours = {"error": off(found.params), "standard_error": expected, "s": min(seconds), "first_s": seconds[0]}
        yield of | {"by": "linkax"} | ours
        for step in STEPS:
            began = time.perf_counter()
            by = of | {"by": f"mujoco sysid, {step:g} s"}
            try:
                params = _by_mujoco(is_loop, angles, told, start, step)
            except ValueError as error:  # of a run that became unstable
                yield by | {"failed": str(error)}
                continue
            yield by | {"error": off(params), "s": time.perf_counter() - began}


def _by_mujoco(is_loop, angles, told, start, step) -> dict[str, float]:
    """What MuJoCo's toolbox finds."""
    import mujoco
    from mujoco import sysid

    def link(name, joint, length, mass, at, inner="", options=""):
        inertia = mass * length**2 / 12.0
        return (
            f'<body name="{name}" pos="{at} 0 0"><joint name="{joint}" axis="0 0 1" {options}/>'
            f'<inertial pos="{length / 2} 0 0" mass="{mass}" diaginertia="1e-6 {inertia} {inertia}"/>'
            f'<site name="{name}_tip" pos="{length} 0 0"/>{inner}</body>'
        )

    spring = f'stiffness="{start["stiffness"]}" springref="{2.4 if is_loop else -1.0}"'
    coupler = link("coupler", "crank_pin", 0.8, start["coupler_mass"], 0.3, options="" if is_loop else spring)
    bodies = link("crank", "bearing", 0.3, 1.0, 0.0, coupler, f'damping="{start["damping"]}"')
    loop = ""
    if is_loop:
        bodies += link("rocker", "pivot", 0.6, 1.2, 0.9, options=spring)
        stiff = f'solref="{2.0 * step} 1" solimp="0.9999 0.9999 0.001"'
        loop = f'<equality><connect site1="coupler_tip" site2="rocker_tip" {stiff}/></equality>'
    sensors = "".join(f'<jointpos name="{name}" joint="{name}"/>' for name in told)
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><compiler angle="radian"/><option integrator="RK4" timestep="{step}" gravity="0 -9.81 0"/>'
        f"<worldbody>{bodies}</worldbody>{loop}"
        f'<actuator><motor name="torque" joint="bearing"/></actuator><sensor>{sensors}</sensor></mujoco>'
    )

    def set_mass(spec, parameter):
        body, mass = spec.body("coupler"), float(parameter.value[0])
        body.mass, body.inertia = mass, [1e-6, mass * 0.8**2 / 12.0, mass * 0.8**2 / 12.0]

    def set_joint(joint, name):
        linear = lambda value: np.array([[value], [0.0], [0.0]])
        return lambda spec, parameter: setattr(spec.joint(joint), name, linear(parameter.value[0]))

    change = {
        "coupler_mass": set_mass,
        "damping": set_joint("bearing", "damping"),
        "stiffness": set_joint("pivot" if is_loop else "crank_pin", "stiffness"),
    }
    params = sysid.ParameterDict()
    for name, value in start.items():
        params.add(sysid.Parameter(name, value, 0.1 * value, 3.0 * value, modifier=change[name]))
    model = spec.compile()
    places = np.zeros(model.nq)
    for name, angle in angles.items():
        places[model.joint(name).qposadr[0]] = angle
    begin = sysid.create_initial_state(model, places, np.zeros(model.nv), np.zeros(0))
    controls = np.arange(0.0, 2.0 + step / 2.0, step)
    control = sysid.TimeSeries(controls, np.full((len(controls), 1), 0.5))
    # States, as its sensors tell those of the step before.
    names = [(name, sysid.SignalType.MjStateQPos) for name in told]
    measured = sysid.TimeSeries.from_names(SAMPLES, np.stack(list(told.values()), axis=1), model, names)
    sequences = sysid.ModelSequences("linkage", spec, "record", begin, control, measured)
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    with contextlib.redirect_stdout(io.StringIO()):  # each iteration
        found, _ = sysid.optimize(initial_params=params, residual_fn=residual, verbose=False)
    return {name: found[name].value[0] for name in start}


if __name__ == "__main__":
    print_parts(__doc__, {"coverage": coverage, "sysid": sysid})
