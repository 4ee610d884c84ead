"""The report of a build: sentences on what was built and what was lost (thesis 3.4).

The report has no dates or paths, so equal inputs give equal bytes.
"""

from collections.abc import Sequence
from typing import Final

from machines.bm2 import BM2Machine
from machines.parameters import PriorMode, SensorMode
from toolchain.building.bm2_machine import clipped
from toolchain.building.machine import MachinePlan
from toolchain.building.quantise import Quantised
from toolchain.deployment import Deployment, MachineSection
from toolchain.errors import counted
from toolchain.models.model import Model
from toolchain.models.network import NetworkModel

SHARED_BITS: Final = {
    "BM1": "means are correct, but the variance of counts is up to 2.6 times as large",
    "BM2": "this biases all samples",
}
"""What happens in a machine if consecutive random numbers share bits, by kind of machine.

Each text is the last part of a sentence in a report or a finding.
"""


def build_report(model: Model, deployment: Deployment, quantised: Quantised, interface_reason: str) -> str:
    """Return the report of a BM1."""
    machine = deployment.machine
    grid = " x ".join(f"{d.label} {d.size}" for d in model.searched)
    names = ", ".join(
        each.name + (f" (table of {each.table_of})" if each.table_of else "") for each in deployment.sensors
    )
    count = counted(len(model.known), "known variable")
    if names:
        names = f", in the order of the columns: {names}" if len(model.known) > 1 else f", {names}"
    sentence = (
        f"Machine: BM1, since {MachinePlan.why}. Codes of {machine.prob_bits} bits (scale = {machine.scale}), counters of "
        f"{machine.counter_bits} bits, stops at a count of {machine.target_count} or after {machine.max_cycles} "
        f"cycles, stop = {machine.stop}; {_generators(machine)}{many_sentence(machine)}"
    )
    places = [
        f"lines {each.line_offset} to {each.line_offset + each.lines - 1}" for each in deployment.boards
    ]
    return _report(
        model,
        deployment,
        f"{model.lines} lines ({grid}), {count}{names}.",
        [*_prior_paragraph(model, deployment), sentence],
        interface_reason,
        _boards(deployment, "", places),
        loss_heading(machine.sensor_mode) + "\n" + _loss_table(quantised),
        *(f"Warning: {warning}" for warning in quantised.warnings),
    )


def bm2_report(
    model: NetworkModel, deployment: Deployment, machine: BM2Machine, why: str, interface_reason: str
) -> str:
    """Return the report of a BM2. `why` is a clause with the reason why the machine is a BM2."""
    searched = ", ".join(f"{each.label} ({each.size})" for each in model.searched)
    known = ", ".join(model.known) or "nothing"
    parameters, limits = machine.parameters, deployment.machine
    sentence = (
        f"Machine: BM2, since {why}. Codes of {parameters.prob_bits} bits, sequencer = {parameters.sequencer}"
        + (", literal" if parameters.literal else "")
        + f"; each board draws {limits.target_count} samples, one per {parameters.sample_every}, after "
        f"{parameters.burn_in} sweeps, or stops after {limits.max_cycles} cycles, or {parameters.ops_timeout} of one move; "
        + _generators(limits)
    )
    if parameters.stream:
        sentence += f" All samples go to /bm/samples; the board's buffer holds {parameters.stream}."
    return _report(
        model,
        deployment,
        f"{len(model.symbols)} variables in {parameters.state_bits} bits, {parameters.cdes} factors; "
        f"it searches {searched}, and knows {known}.",
        [sentence],
        interface_reason,
        _boards(
            deployment,
            ", each with a chain of its own",
            [f"chain {each.line_offset}" for each in deployment.boards],
        ),
        "CDEs (clipped: odds of used codes that are 0 or infinite, or too extreme for a code):\n"
        + _cde_table(model, machine),
        "The VHDL of a BM2 does not exist yet, so there are memories, but no parameters and no project.",
    )


def _report(
    model: Model | NetworkModel,
    deployment: Deployment,
    content: str,
    machine: Sequence[str],
    interface_reason: str,
    *rest: str,
) -> str:
    paragraphs = [
        f"Model {model.name}: {content}",
        *_state_paragraph(model),
        *machine,
        f"Interface: {deployment.machine.interface}{interface_reason}.",
        *rest,
        f"{_topics_sentence(deployment)} Deployment {deployment.hash[:16]}.",
    ]
    return "\n\n".join(paragraphs) + "\n"


def _generators(machine: MachineSection) -> str:
    steps = counted(machine.steps_per_clock, "step")
    text = (
        f"{machine.rng} with {machine.rng_banks} banks, rng_reset = {machine.rng_reset}, {steps} per clock."
    )
    if machine.rng.lfsr_bits is not None and machine.steps_per_clock < machine.prob_bits:
        text += f" With so few steps, consecutive random numbers share bits: {SHARED_BITS[machine.type]}."
    return text


def _boards(deployment: Deployment, what: str, places: Sequence[str]) -> str:
    return f"Boards: {len(places)}{what}.\n" + "\n".join(
        f"  {board.image}: {place}, image {board.image_hash[:16]}"
        for board, place in zip(deployment.boards, places, strict=True)
    )


def loss_heading(sensor_mode: SensorMode) -> str:
    """Return the heading above the table of quantisation losses."""
    posterior = "the column's own posterior"
    if sensor_mode is SensorMode.CELL:
        posterior += " where all lines read the same"
    return f"Lost by quantising (mass: how often the true line has code 0; KL: of {posterior}, bits):"


def many_sentence(machine: MachineSection) -> str:
    """Describe multiple readings per variable or multiple posteriors per frame. Return "" if there are neither."""
    sentence = {
        SensorMode.COLUMN: "",
        SensorMode.CELL: f" Each of the {machine.lines} lines has a reading of its own (sensor_mode = cell).",
        SensorMode.THRESHOLD: (
            f" Readings are probabilities, one for each of the {machine.lines} lines (sensor_mode = threshold); there are no "
            "tables."
        ),
    }[machine.sensor_mode]
    if machine.replicas > 1:
        sentence += (
            f" Each board holds {machine.replicas} of these machines around the same generators: a frame brings {machine.replicas} "
            f"sets of readings and gives {machine.replicas} posteriors."
        )
    return sentence


def edited_sentence(deployment: Deployment) -> str:
    """Return sentences that name the boards with edited images and warn about comparisons with the model."""
    boards = ", ".join(map(str, deployment.edited_boards))
    return (
        f"Edited since the build: the image of board {boards}. Its codes may not be the model's, so a difference from the "
        "model includes the edit."
    )


def _topics_sentence(deployment: Deployment) -> str:
    """Return a sentence with the topic of the posteriors and the sources of the readings.

    If there are several sources, the sentence lists the variables of each source.
    """
    output = deployment.outputs[0]
    places = [f"{source.uri}, topic {source.topic} ({source.type})" for source in deployment.sources]
    if len(places) == 1:
        return f"Readings come from {places[0]}; posteriors go to {output.topic}."
    for at, place in enumerate(places):
        names = [variable.name for variable in deployment.variables if variable.source == at]
        if deployment.prior is not None and deployment.prior.source == at:
            names.append("the prior")
        places[at] = f"\n  {place}: {', '.join(names)}"
    return (
        f"Readings come from {len(places)} topics, together where their stamps are within "
        f"{deployment.tolerance_s:g} s:{''.join(places)}\n"
        f"Posteriors go to {output.topic} on {deployment.output_uri(output)}."
    )


def _state_paragraph(model: Model | NetworkModel) -> list[str]:
    named = [
        f"  {name}: " + ", ".join(f"{offset + at * step:g} {state}" for at, state in enumerate(states))
        for name, offset, step, states in (
            *((each.label, each.offset, each.step, each.states) for each in model.searched),
            *((each.name, each.offset, each.step, each.states) for each in model.variables),
        )
        if states
    ]
    return ["States, as numbers; a reading may be either:\n" + "\n".join(named)] if named else []


def _prior_paragraph(model: Model, deployment: Deployment) -> list[str]:
    if (select := model.prior_select) is not None:
        return [
            f"Prior: selected by {select.name}, one of {select.values} rows; a missing reading takes the prior without it."
        ]
    if deployment.machine.prior_mode is not PriorMode.WRITTEN:
        return []
    if deployment.filter is not None:
        return ["Prior: written every frame, predicted by the filter from the posterior of the frame before."]
    if deployment.prior is None:
        return ["Prior: written by the host; the model's own until it is."]
    return [f"Prior: written every frame, from {deployment.prior.path} of the message."]


def _loss_table(quantised: Quantised) -> str:
    width = max(len(loss.name) for loss in quantised.losses)
    rows = [f"  {'column':{max(width, 6)}}  bits  values       mass         KL"]
    rows += [
        f"  {loss.name:{max(width, 6)}}  {loss.bits:4d}  {loss.values:6d}  {loss.mass:9.2e}  {loss.kl_bits:9.2e}"
        for loss in quantised.losses
    ]
    return "\n".join(rows)


def _cde_table(model: NetworkModel, machine: BM2Machine) -> str:
    width, p = max(map(len, model.titles)), machine.parameters
    rows = [f"  {'factor':{width}}  bits    codes  clipped"]
    for at, (title, table) in enumerate(zip(model.titles, machine.tables, strict=True)):
        clips, _, _ = clipped(model.factors[at].table, p.prob_bits)
        rows.append(f"  {title:{width}}  {len(p.factor_bits(at)):4d}  {table.size:7d}  {clips:7d}")
    return "\n".join(rows)
