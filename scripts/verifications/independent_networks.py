"""pyagrum's part of scripts/verify networks, which reads, writes and infers in its own environment.

independent_networks.py read FOLDER     NAME.bif --> NAME.npz (tables), NAME.bifxml, NAME.net, NAME.uai
independent_networks.py infer FOLDER    questions.json --> answers.npz
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyagrum

_IDENTIFIER = re.compile(r"[A-Za-z]\w*")


def load(path: Path) -> pyagrum.BayesNet:
    """Read a BIF file's network, with labels in hexadecimal that pyagrum does not accept as identifiers."""

    def renamed(match: re.Match[str]) -> str:
        labels = [label.strip() for label in match[2].split(",")]
        plain = [each if _IDENTIFIER.fullmatch(each) else "x_" + each.encode().hex() for each in labels]
        return match[1] + ", ".join(plain) + match[3]

    text = path.read_text()
    text = re.sub(r"(type discrete \[ \d+ \] \{ )(.*?)( \};)", renamed, text)
    text = re.sub(r"(?m)^(  \()(.*?)(\) )", renamed, text)
    other = path.with_suffix(".plain.bif")
    other.write_text(text)
    return pyagrum.loadBN(str(other))


def axes(table: pyagrum.Tensor) -> list[str]:
    """Return the names of a table's axes as an array, in the reverse of pyagrum's order."""
    return list(reversed(table.names))


def read(folder: Path) -> None:
    """Save every network's tables, with the axes child and then parents, and write it in the other formats."""
    for path in sorted(folder.glob("*.bif")):
        if path.name.endswith(".plain.bif"):
            continue
        network = load(path)
        arrays, described = {}, []
        for number in range(network.size()):
            variable = network.variable(number)
            table = network.cpt(number)
            names = axes(table)
            parents = [name for name in names if name != variable.name()]
            order = [names.index(name) for name in (variable.name(), *parents)]
            arrays[f"table{number}"] = np.transpose(table.toarray(), order)
            described.append(
                {
                    "name": variable.name(),
                    "labels": list(variable.labels()),
                    "parents": parents,
                    "number": number,
                }
            )
        arrays["described"] = np.array(json.dumps(described))
        np.savez(path.with_suffix(".npz"), allow_pickle=False, **arrays)
        network.saveBIFXML(str(path.with_suffix(".bifxml")))
        network.saveNET(str(path.with_suffix(".net")))
        path.with_suffix(".uai").write_text(uai(described, arrays))


def uai(described: list[dict[str, Any]], arrays: dict[str, np.ndarray]) -> str:
    """Return a network as UAI defines it, with the child last in its scope and varying fastest.

    In pyagrum's own writer the first parent varies fastest, but the format requires the last.
    """
    number = {each["name"]: each["number"] for each in described}
    lines = [
        "BAYES",
        str(len(described)),
        " ".join(str(len(each["labels"])) for each in described),
        str(len(described)),
    ]
    for each in described:
        scope = [number[name] for name in (*each["parents"], each["name"])]
        lines.append(" ".join(map(str, [len(scope), *scope])))
    for each in described:
        values = np.moveaxis(arrays[f"table{each['number']}"], 0, -1).ravel().tolist()
        lines += [str(len(values)), " ".join(map(repr, values))]
    return "\n".join(lines) + "\n"


def infer(folder: Path) -> None:
    """Answer questions: posteriors of the searched variables, the first varying slowest, and separated pairs."""
    questions = json.loads((folder / "questions.json").read_text())
    answers = {}
    networks: dict[str, pyagrum.BayesNet] = {}
    for number, question in enumerate(questions):
        name = question["network"]
        if name not in networks:
            networks = {name: load(folder / f"{name}.bif")}
        network = networks[name]
        if "pair" in question:
            answers[f"answer{number}"] = np.array(
                network.isIndependent(*question["pair"], question["searched"])
            )
            continue
        inference = pyagrum.LazyPropagation(network)
        searched = question["searched"]
        # Only the part that the targets need is triangulated, because some networks are too large as a whole.
        inference.eraseAllTargets()
        if len(searched) > 1:
            inference.addJointTarget(set(searched))
        else:
            inference.addTarget(searched[0])
        found = []
        for row in question["rows"]:
            inference.setEvidence(dict(zip(question["known"], row, strict=True)))
            inference.makeInference()
            if len(searched) > 1:
                posterior = inference.jointPosterior(set(searched))
                table = np.transpose(posterior.toarray(), [axes(posterior).index(each) for each in searched])
            else:
                table = inference.posterior(searched[0]).toarray()
            found.append(table.ravel())
        answers[f"answer{number}"] = np.array(found)
    np.savez(folder / "answers.npz", allow_pickle=False, **answers)


if __name__ == "__main__":
    {"read": read, "infer": infer}[sys.argv[1]](Path(sys.argv[2]))
