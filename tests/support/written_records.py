"""Load frames' records as their programs write them: the readings are given by formula, everything else varies."""

from __future__ import annotations

import dataclasses
import random
from dataclasses import dataclass

#: newtons in each unit, typed from NIST SP 811 and not taken from the program
NEWTONS = {
    "N": 1.0,
    "kN": 1000.0,
    "MN": 1e6,
    "mN": 1e-3,
    "cN": 1e-2,
    "daN": 10.0,
    "lbf": 4.4482216152605,
    "kip": 4448.2216152605,
    "kgf": 9.80665,
    "gf": 9.80665e-3,
}
SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "Sec": 1.0, "sec": 1.0}
TIMES = {
    "en": ["Time", "Test time", "Running Time", "Elapsed Time", "Total Time"],
    "de": ["Zeit", "Prüfzeit", "Testzeit", "Versuchszeit"],
    "fr": ["Temps", "C_1_Temps", "Temps écoulé"],
    "es": ["Tiempo", "Tiempo de ensayo"],
    "it": ["Tempo", "Tempo di prova"],
    "pt": ["Tempo", "Tempo decorrido"],
    "nl": ["Tijd", "Testtijd"],
    "ja": ["時間", "試験時間"],
    "zh": ["时间", "试验时间"],
}
#: force and extension
OTHERS = {
    "en": ("Load", "Extension"),
    "de": ("Standardkraft", "Standardweg"),
    "fr": ("Force", "Déplacement"),
    "es": ("Fuerza", "Desplazamiento"),
    "it": ("Forza", "Corsa"),
    "pt": ("Força", "Deslocamento"),
    "nl": ("Kracht", "Verplaatsing"),
    "ja": ("試験力", "変位"),
    "zh": ("力", "位移"),
}
ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"]
FOREIGN = {"ja": "cp932", "zh": "gb18030"}
#: between cells; decimal mark; between groups of thousands
NOTATIONS = [
    (",", ".", ""),
    (",", ".", ","),
    (",", ",", ""),
    (",", ",", "."),
    (";", ",", ""),
    (";", ",", "."),
    (";", ",", " "),
    (";", ",", "\u202f"),
    (";", ",", "\u00a0"),
    (";", ".", ""),
    (";", ".", "'"),
    ("\t", ".", ""),
    ("\t", ".", ","),
    ("\t", ",", ""),
    ("\t", ",", "\u00a0"),
]
HEADS = ["none", "title", "pairs", "numbers", "bluehill", "testxpert", "mts", "results"]
FOOTERS = ["none", "blank", "statistics", "note"]


@dataclass(frozen=True)
class Form:
    """Everything about a record but its readings."""

    language: str = "en"
    time: str = "Time"
    separator: str = ","
    decimal: str = "."
    group: str = ""
    quoted: bool = False
    units: str = "brackets"
    force: str = "N"
    seconds: str = "s"
    encoding: str = "utf-8"
    head: str = "none"
    footer: str = "none"
    order: tuple[int, ...] = (0, 1, 2)
    line_end: str = "\r\n"
    trailing: bool = False


def number(value: float, digits: int, form: Form) -> str:
    """Write a number in the record's notation."""
    return f"{value:,.{digits}f}".replace(",", "g").replace(".", form.decimal).replace("g", form.group)


def line(cells: list[str], form: Form) -> str:
    """Write a row of cells; a cell that holds the separator is quoted."""
    cells = [f'"{c}"' if form.quoted or form.separator in c else c for c in cells]
    return form.separator.join(cells) + (form.separator if form.trailing else "")


def head(form: Form) -> list[str]:
    """Write the lines above the titles."""
    pair = {
        "none": [],
        "title": [["Machine 7"], ["Tensile test, 2026"]],
        "pairs": [["Operator", "A. B."], ["Specimen", "P-07"], ["Date", "2026-03-01"]],
        "numbers": [["Width", number(12.5, 3, form), "mm"], ["Speed", number(2.0, 3, form), "mm/min"]],
        "bluehill": [
            ["Specimen properties : Specimen label", "P-07"],
            ["Maximum Load : Maximum Load", number(2250.0, 3, form), "N"],
        ],
        "testxpert": [["Prüfer", "M"], ["Vorkraft", number(5.0, 2, form), "N"], ["Einspannlänge", number(50, 2, form)]],
        "mts": [["MTS793|MPT|ENU|1|2|.|/|:|1|0|0|A"], [], ["Data Acquisition:", "Timed"], ["Station Name:", "one"]],
        "results": [
            ["Specimen", "Width (mm)", "Maximum (N)"],
            ["1", number(12.5, 3, form), number(2250.0, 3, form)],
            [],
        ],
    }[form.head]
    return [line(cells, form) for cells in pair] + ([""] if pair else [])


def footer(form: Form) -> list[str]:
    """Write the lines below the readings."""
    return {
        "none": [],
        "blank": ["", ""],
        "statistics": [
            line(["Maximum", number(2250.0, 3, form), number(0.45, 3, form)], form),
            line(["Mean", number(1125.0, 3, form), number(0.225, 3, form)], form),
        ],
        "note": ["", "End of the test"],
    }[form.footer]


def written(form: Form, rows: list[tuple[float, float, float]]) -> bytes:
    """Write a record of times in s, forces in N and extensions in mm."""
    force, extension = OTHERS[form.language]
    titles, units = [form.time, force, extension], [form.seconds, form.force, "mm"]
    if form.units == "brackets":
        heads = [[f"{t} ({u})" for t, u in zip(titles, units, strict=True)]]
    elif form.units == "square":
        heads = [[f"{t}[{u}]" for t, u in zip(titles, units, strict=True)]]
    else:
        heads = [titles, [f"({u})" if form.units == "row in brackets" else u for u in units]]
    ordered = [[cells[k] for k in form.order] for cells in heads]
    lines = head(form) + [line(cells, form) for cells in ordered]
    for t, f, x in rows:
        cells = [
            number(t / SECONDS[form.seconds], 3 if form.seconds != "min" else 7, form),
            number(f / NEWTONS[form.force], 3 if NEWTONS[form.force] <= 10 else 8, form),
            number(x, 5, form),
        ]
        lines.append(line([cells[k] for k in form.order], form))
    return (form.line_end.join(lines + footer(form)) + form.line_end).encode(form.encoding)


def forms(count: int, seed: int) -> list[Form]:
    """Draw forms of records that can be written: with a code page that has their letters."""
    draw = random.Random(seed)
    found: list[Form] = []
    while len(found) < count:
        language = draw.choice(list(TIMES))
        separator, decimal, group = draw.choice(NOTATIONS)
        form = Form(
            language=language,
            time=draw.choice(TIMES[language]),
            separator=separator,
            decimal=decimal,
            group=group,
            quoted=draw.random() < 0.4,
            units=draw.choice(["brackets", "square", "row", "row in brackets"]),
            force=draw.choice(list(NEWTONS)),
            seconds=draw.choice(list(SECONDS)),
            encoding=draw.choice([*ENCODINGS, FOREIGN.get(language, "cp1252")]),
            head=draw.choice(HEADS),
            footer=draw.choice(FOOTERS),
            order=draw.choice([(0, 1, 2), (1, 0, 2), (2, 1, 0)]),
            line_end=draw.choice(["\n", "\r\n"]),
            trailing=draw.random() < 0.15,
        )
        try:
            written(form, [(1e6, 1e6, 0.0)])
        except UnicodeEncodeError:
            form = dataclasses.replace(form, encoding="utf-16")
        found.append(form)
    return found
