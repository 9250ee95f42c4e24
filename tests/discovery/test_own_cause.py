"""A user's own cause: one object in a file or a package, checked on loading, named, stored, and simulated
again."""

from __future__ import annotations

import json
import pickle
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.documents import document
from builders.fit_case import bare_fit
from plants import plant
from plants.as_record import to_record

import hygrokf
from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.commands.main import main
from hygrokf.data.result_file import ResultFault
from hygrokf.data.signals import SIGNALS
from hygrokf.data.toml_form import Place
from hygrokf.discovery.own_causes import (
    declared_faults,
    expect_usable,
    form_faults,
    load_library,
    trial_ground,
    trial_record,
)
from hygrokf.identification.fit import LibraryAbsent, read_fit, write_fit
from hygrokf.live.config import read_turbine
from hygrokf.modelling.causes.cause import cause_of
from hygrokf.modelling.derived_inputs import FEATURES
from hygrokf.modelling.design import Design, design, extended
from hygrokf.modelling.inputs import model_inputs
from hygrokf.modelling.library import LIBRARY, LibraryFault
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.physics.mechanisms.heat import wind_loss
from hygrokf.physics.mechanisms.moisture import wind_exchange

PAGE = document("own_cause.md")
WORDS = {"meaning": "it warms", "remedy": "look", "separate_by": "measure"}
FILE = """
import hygrokf
from hygrokf.physics.expression import exp, log
from hygrokf.modelling.causes.forms import Form

def parameter(name, null=0.0, **more):
    return hygrokf.Parameter(name, "K", 1.0, -50.0, 50.0, null=null, meaning="an effect", **more)

def made(effect, parameters=("stove_heat",), name="stove", inputs=("auxiliary_power",), **more):
    def factory():
        return hygrokf.Mechanism(
            name, tuple(parameter(p) if isinstance(p, str) else p for p in parameters), inputs=inputs,
            contributions=effect, **more)
    return factory

WORDS = dict(meaning="it warms", remedy="look", separate_by="measure")

def stove(p, x, u, q):
    return {"heat_release": p.stove_heat * 1e-4 * u.auxiliary_power}

"""


@pytest.fixture(autouse=True)
def _as_it_was() -> Iterator[None]:
    """Nothing that a test brings stays in the package's tables."""
    before = dict(MECHANISMS), dict(FEATURES), vars(LIBRARY).copy()
    yield
    assert (dict(MECHANISMS), dict(FEATURES), vars(LIBRARY)) == before


def documented() -> str:
    """transformer.py as the page has it."""
    return re.search(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)[1]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "transformer.py"
    path.write_text(documented(), encoding="utf-8")
    return path


def written(tmp_path: Path, text: str, name: str = "own.py") -> Path:
    path = tmp_path / name
    path.write_text(FILE + text, encoding="utf-8")
    return path


def faults_of(*paths: Path) -> tuple[str, ...]:
    with pytest.raises(LibraryFault) as caught:
        load_library(*paths)
    return caught.value.faults


# -- loading -------------------------------------------------------------------------------------------------
def test_a_file_brings_its_cause(file: Path) -> None:
    library = load_library(file)
    (cause,) = library.own
    assert (cause.name, cause.needs, list(cause.mechanisms)) == (
        "transformer_heat", "auxiliary_power", ["transformer_heat"],
    )  # fmt: skip
    assert library.mechanisms["transformer_heat"]().inputs == ("auxiliary_power",)
    assert library.causes == (*LIBRARY.causes, cause) and "transformer_heat" in repr(library)
    (form,) = cause.forms(trial_ground())
    assert (form.heat, form.vapour) == ((("transformer_heat", {}),), ())
    again = library.with_causes(cause)  # once more changes nothing
    assert (again.causes, again.origins) == (library.causes, library.origins)
    assert [one.name for one in load_library(file).own] == [cause.name]
    assert len(load_library(file, file, file.parent / "." / file.name).own) == 1
    assert load_library().causes == LIBRARY.causes


def test_the_extended_model_is_the_base_at_the_null_value_on_another_record(file: Path) -> None:
    record = trial_record()
    base = design(record, kind="thermal", library=load_library(file))
    wider = extended(base, [("transformer_heat", {})])
    values = {p.name: p.start for p in base.model.parameters}
    for gain, same in ((0.0, True), (3.0, False)):
        before, after = (
            hygrokf.Likelihood(one.model, model_inputs(one, record).timeline).value(
                {**values, "transformer_gain": gain}
            )
            for one in (base, wider)
        )
        assert (before == pytest.approx(after, abs=1e-9)) is same


def test_a_design_with_an_own_mechanism_goes_to_json_and_back(file: Path) -> None:
    import hashlib

    base = design(trial_record(), kind="thermal", library=load_library(file))
    wider = extended(base, [("transformer_heat", {})])
    stored = json.loads(json.dumps(wider.to_json()))
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    assert stored["origins"] == {"transformer_heat": {"file": "transformer.py", "sha256": sha256}}
    again = replace(Design.from_json(stored), library=base.library)
    assert again == wider and again.to_json() == wider.to_json()
    assert "origins" not in design(trial_record(), kind="thermal").to_json()


def test_a_mechanism_brings_its_features(tmp_path: Path) -> None:
    text = """
def late(record, time):
    return (time > record.start_s + 1e6).astype(float)

def warm(p, x, u, q):
    return {"heat_release": p.late_heat * u.late * u.standstill}

brought = {"late": (late, "mean")}
factory = made(warm, ("late_heat",), "late_warmth", ("late", "standstill"), features=brought)
LATE = hygrokf.cause_of("late_warmth", thermal=factory, **WORDS)
"""
    library = load_library(written(tmp_path, text))
    (cause,) = library.own
    assert (list(cause.mechanisms), list(cause.features)) == (["late_warmth"], ["late"])
    (form,) = cause.forms(trial_ground())
    assert form.grid[0].features == {"standstill": {}, "late": {}}
    base = design(trial_record(), kind="thermal", library=library)
    assert extended(base, [("late_warmth", {})]).features == {"late": {}, "standstill": {}}
    bare = replace(cause, name="bare", features={}, forms=lambda ground: [])
    (fault, *_) = declared_faults(bare)
    assert "late" in fault and "features=" in fault


def test_a_cause_of_a_mechanism_of_the_package_brings_nothing_of_its_own() -> None:
    cause = cause_of("windy", thermal=wind_loss, hygric=wind_exchange, needs=("wind_speed",), **WORDS)
    assert (cause.mechanisms, cause.features, cause.needs) == ({}, {}, "wind_speed")
    (form,) = cause.forms(trial_ground())
    assert (form.heat, form.vapour) == ((("wind_loss", {}),), (("wind_exchange", {}),))
    assert form.grid[0].features == {"wind_tenth": {}} and form_faults(cause, LIBRARY) == []


def test_the_vapour_cannot_read_what_the_heats_base_model_derives_from_the_power() -> None:
    """It would be named and could not be simulated afterwards; its standstill is a feature."""

    def source(read: str) -> Callable[[], hygrokf.Mechanism]:
        parameter = hygrokf.Parameter("leak", "g/m3/h", 0.1, -1.0, 1.0, null=0.0, meaning="a leak")
        return lambda: hygrokf.Mechanism(
            "leak", (parameter,), inputs=(read,),
            contributions=lambda p, x, u, q: {"vapour_release": p.leak * getattr(u, read)},
        )  # fmt: skip

    forms = {
        read: cause_of("leaking", hygric=source(read), **WORDS).forms(trial_ground())
        for read in ("power_1", "active_power", "standstill")
    }
    assert forms["power_1"] == [] and forms["active_power"] and forms["standstill"]


def test_every_signal_of_the_table_can_be_an_input() -> None:
    """Each has a hold, and a run finds it in the record."""
    record = trial_record()
    names = tuple(sorted(set(SIGNALS) - {"cabinet_temperature"}))

    def everything() -> hygrokf.Mechanism:
        parameter = hygrokf.Parameter("all_of_it", "K", 0.0, -1.0, 1.0, null=0.0, meaning="share")
        return hygrokf.Mechanism(
            "everything", (parameter,), inputs=names,
            contributions=lambda p, x, u,
            q: {"heat_release": p.all_of_it * sum(getattr(u, n) for n in names)},
        )  # fmt: skip

    library = LIBRARY.with_causes(cause_of("everything", thermal=everything, **WORDS))
    expect_usable(library)
    wider = extended(design(record, kind="thermal", library=library), [("everything", {})])
    assert set(names) <= set(wider.model.inputs)
    t = model_inputs(wider, record).timeline
    np.testing.assert_allclose(t.input("heater_duty")[1:], record["heater_duty"].value[:-1])
    np.testing.assert_allclose(t.input("tower_temperature"), record["tower_temperature"].value)


def test_the_packages_own_causes_pass_the_check_that_users_causes_must_pass() -> None:
    for cause in LIBRARY.causes:
        # the trial record has a door's contact
        assert cause.name == "door_opening" or form_faults(cause, LIBRARY) == [], cause.name


# -- faults --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x00\x01\xff\xfe", "expected a Python file, found"),
        (b"def broken(:\n    pass\n", "expected a Python file, found invalid syntax in line 1"),
        (b"import no_such_module_anywhere\n", "No module named 'no_such_module_anywhere' (line 1 of own.py)"),
        (b"import sys\nsys.exit(3)\n", "cannot be run: SystemExit: 3 (line 2 of own.py)"),
        (b"a = 1\nb = a / 0\n", "cannot be run: ZeroDivisionError: division by zero (line 2 of own.py)"),
        (b"a = 1\n", "expected a hygrokf.Cause at the top level, found none"),
        (
            b"from hygrokf.modelling.library import CAUSES\nSUN = CAUSES[3]\n",
            "at the top level, found none",
        ),
        (b"import hygrokf\nC = hygrokf.cause_of('a', meaning='', remedy='', separate_by='')", "found none"),
        (
            b"import hygrokf\nC = hygrokf.cause_of('a', thermal=list, meaning='', remedy='', separate_by='')",
            "expected factories that return a Mechanism: thermal (line 2 of own.py)",
        ),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "own.py"
    path.write_bytes(content)
    (fault,) = faults_of(path)
    assert fault.startswith("own.py: ") and words in fault


CAUSE = "C = hygrokf.cause_of('stove', thermal=made({effect}), **WORDS)\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: "
            "{'heat_release': p.stove_heat * 1e-4 * u.auxiliary_power + 1.0}), **WORDS)",
            "expected the base model at the null value (stove_heat = 0), found a simulation that differs by",
        ),
        (  # at the start value of the second parameter it looks nested
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: "
            "{'heat_release': p.stove_heat * 1e-4 * u.auxiliary_power + (p.stove_loss - 1.0)}, "
            "('stove_heat', parameter('stove_loss', None))), **WORDS)",
            "every effect must vanish there",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: {'heat_relase': p.stove_heat}), "
            "**WORDS)",
            'mechanism "stove" adds to the sum "heat_relase", which no mechanism reads; did you mean '
            '"heat_release"?',
        ),
        (
            "C = hygrokf.cause_of('stove', hygric=made(stove), **WORDS)",
            "expected an effect on the simulated vapour, found none at any parameter values; let the "
            "mechanism contribute to one of heat_release",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove, (parameter('stove_heat', None),)), **WORDS)",
            "expected a parameter with a null value at which it has no effect, found none",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove, (parameter('stove_heat', 99.0),)), **WORDS)",
            "the null value 99 of stove_heat is outside of its bounds",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove, inputs=('auxilary_power',)), **WORDS)",
            "unknown input 'auxilary_power': no signal and no feature; did you mean \"auxiliary_power\" or",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), needs=('snow',), **WORDS)",
            "forms: expected at least one form for a record with every signal (30 days, hourly), found none",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: [], mechanisms=[made(stove)], "
            "features=3)",
            "mechanisms: expected a mapping of names, found [",
        ),
        (
            "import numpy as np\nC = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: "
            "{'heat_release': np.sin(p.stove_heat * u.auxiliary_power)}), **WORDS)",
            "form 'as given': TypeError",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: {'heat_release': p.heat}), "
            "**WORDS)",
            "form 'as given': UnknownName: a mechanism reads p.heat, but the parameters here are ",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), starts={'stov_heat': 2.0}, **WORDS)",
            "values of unknown parameters stov_heat; it has stove_heat",
        ),
        (
            "C = hygrokf.cause_of('solar_gain', thermal=made(stove), **WORDS)",
            "cause 'solar_gain': the package has a cause of that name",
        ),
        (
            "C = hygrokf.cause_of('Stove 2', thermal=made(stove), **WORDS)",
            "name: expected an identifier in small letters such as damp_wall, found 'Stove 2'",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove, name='wall_thermal_mass'), **WORDS)",
            "mechanism 'wall_thermal_mass': the package has a mechanism, feature or signal of that name",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove, ('stove_heat', 'heater_heat')), **WORDS)",
            "the package has parameters or states named heater_heat; rename them",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), **{**WORDS, 'remedy': ' '})",
            "remedy: expected a sentence, found ' '",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), "
            "features={'rain': (lambda record, time: time, 'linear')}, **WORDS)",
            "feature 'rain': the package has a mechanism, feature or signal of that name",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), "
            "features={'operating': (lambda record, time: time, 'linear')}, **WORDS)",
            "feature 'operating': the base models have an input of that name",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), features={'glow': (lambda r, t: t, "
            "'cubic')}, **WORDS)",
            "feature 'glow': expected the hold previous, mean or linear, found 'cubic'",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: {'heat_release': p.stove_heat * "
            "u.glow}, inputs=('glow',)), features={'glow': (lambda record, time: 'no', 'linear')}, **WORDS)",
            "glow: expected 17281 values, found shape ()",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), features={'after_step': {}}, **WORDS)",
            "feature after_step: expected the settings date_s, days, found {}",
        ),
        (
            "def forms(ground):\n    return ground.nothing\n"
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', forms, mechanisms={'stove': made(stove)})",
            "forms fails on a record with every signal: AttributeError: 'Ground' object has no "
            "attribute 'nothing' (line 22 of own.py)",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: ['x'], mechanisms={'stove': "
            "made(stove)})",
            "forms: expected Form objects of the cause stove, found 'x'",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: [Form('stove', 'f', (('oven', {}),))])",
            "form 'f': unknown mechanism 'oven': name one of the package, or add it to the cause's "
            "mechanisms",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(stove), hygric=made(lambda p, x, u, q: "
            "{'heat_release': p.damp}, ('damp',), 'damp'), **WORDS)",
            "expected an effect on the simulated vapour, found none at any parameter values",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: {'heat_release': p.stove_heat * "
            "exp(u.auxiliary_power)}), **WORDS)",
            "(stove_heat = 0), found a simulation that is not finite; every effect must vanish there",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: {'heat_release': "
            "log(1.0 - p.stove_heat)}), **WORDS)",
            "the simulated temperature is not finite near the start values; check divisions, logarithms and",
        ),
        (
            "C = hygrokf.cause_of('stove', thermal=made(lambda p, x, u, q: {'heat_release': p.stove_heat * "
            "u.glow}, inputs=('glow',)), features={'glow': (lambda record, time: time * float('nan'), "
            "'linear')}, **WORDS)",
            "glow: expected finite values, found nan",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: [Form('stove', 'f', (('stove', "
            "{'size': 2}),))], mechanisms={'stove': made(stove)})",
            "form 'f': TypeError: ",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: [Form('stove', 'f', (('stove', {}),), "
            "grid=(), steps={('after_step', 'date_s'): 3600.0})], mechanisms={'stove': made(stove)})",
            "form 'f': expected a grid of at least one Setting, found none",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: [Form('stove', 'f', (('stove', {}),), "
            "steps={('after_step', 'date_s'): 3600.0})], mechanisms={'stove': made(stove)})",
            "steps: expected a setting of a feature in every point of the grid, found 'date_s' of "
            "'after_step'",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: [Form('stove', 'f', (('stove', {}),), "
            "limits={'stov_heat': (0.0, 1.0)})], mechanisms={'stove': made(stove)})",
            "values of unknown parameters stov_heat; it has stove_heat",
        ),
        (
            "def factory(size):\n    return None\nC = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: "
            "[], mechanisms={'stove': factory})",
            "mechanism 'stove': its factory, called without arguments, fails: TypeError",
        ),
        (
            "C = hygrokf.Cause('stove', 'a', 'b', 'c', lambda ground: [], mechanisms={'stove': lambda: 7})",
            "expected its factory to return a Mechanism of that name, found 7",
        ),
    ],
)  # fmt: skip
def test_a_cause_that_cannot_take_part_is_refused(tmp_path: Path, text: str, words: str) -> None:
    faults = faults_of(written(tmp_path, text))
    assert any(words in fault for fault in faults), faults
    assert all(fault.startswith("own.py: cause ") for fault in faults)


def test_all_faults_of_all_files_come_in_one_message(tmp_path: Path) -> None:
    paths = [
        tmp_path / "none.py",
        written(tmp_path, "C = hygrokf.cause_of('stove', thermal=made(stove), **WORDS)", "first.py"),
        written(tmp_path, "C = hygrokf.cause_of('stove', thermal=made(stove), **WORDS)", "second.py"),
        written(tmp_path, "C = hygrokf.cause_of('Oven', thermal=made(stove, name='oven', "
                "parameters=(parameter('stove_heat', None),)), **{**WORDS, 'meaning': ''})", "third.py"),
    ]  # fmt: skip
    with pytest.raises(LibraryFault) as caught:
        load_library(*paths)
    said = str(caught.value)
    assert said.startswith(
        "library of causes: 6 faults\n  1. none.py: expected a Python file, cannot read it: "
    )
    assert "first.py and second.py: two have the cause name 'stove'; rename one" in said
    assert "first.py and second.py: two have the mechanism name 'stove'; rename one" in said
    assert said.count("third.py: cause 'Oven': ") == 3


def test_libraries_with_different_causes_of_one_name_work_side_by_side(tmp_path: Path) -> None:
    """Each is a value: models, runs and origins of one know nothing of the other, nor of a faulty file."""
    feature = GLOWING.replace("NEEDS", "needs=('rain',),")
    strong = feature.replace("return share * np.interp", "return 3.0 * share * np.interp")
    files = [written(tmp_path, text, name) for text, name in ((feature, "a.py"), (strong, "b.py"))]
    libraries = [load_library(one) for one in files]
    record = trial_record()
    values = {"stove_heat": 2.0, **{p.name: p.start for p in design(record, kind="thermal").model.parameters}}
    faults_of(written(tmp_path, GLOWING.replace("NEEDS", "hygric=list,"), "bad.py"))
    found = []
    for _ in range(2):  # what the second one does changes nothing in the first
        for library, share in zip(libraries, (1.0, 3.0), strict=True):
            expect_usable(library)
            wider = extended(design(record, kind="thermal", library=library), [("stove", {})])
            line = model_inputs(wider, record).timeline
            np.testing.assert_allclose(line.input("glow"), share * record["rain"].value)
            assert wider.to_json()["origins"]["stove"]["file"] == ("a.py" if share == 1.0 else "b.py")
            found.append(hygrokf.Likelihood(wider.model, line).value(values))
    assert found[:2] == found[2:] and found[0] != found[1]
    with pytest.raises(LibraryFault, match="two have the cause name 'glowing'"):
        libraries[0].with_causes(*libraries[1].own)
    with pytest.raises(KeyError, match="stove"):
        extended(design(record, kind="thermal"), [("stove", {})])


def test_a_model_of_an_own_mechanism_travels_with_it(file: Path) -> None:
    """A pickle keeps what the user brought; the package's own library comes back as itself."""
    base = design(trial_record(), kind="thermal", library=load_library(file))
    wider = extended(base, [("transformer_heat", {})])
    again = pickle.loads(pickle.dumps(wider))
    assert again == wider and again.library.origins == wider.library.origins
    assert again.model.parameters == wider.model.parameters
    assert pickle.loads(pickle.dumps(design(trial_record()))).library is LIBRARY


def test_a_fit_with_an_own_mechanism_is_refused_without_its_library(file: Path, tmp_path: Path) -> None:
    library, record = load_library(file), trial_record()
    wider = extended(design(record, kind="thermal", library=library), [("transformer_heat", {})])
    values = {p.name: p.start for p in wider.model.parameters}
    write_fit(bare_fit("warm", wider, values), tmp_path)
    again = read_fit(tmp_path, library=library)
    assert again.design == wider and again.values == values and again.design.library is library
    with pytest.raises(LibraryAbsent) as caught:
        read_fit(tmp_path)
    sha256 = library.origins["transformer_heat"]["sha256"]
    assert str(caught.value) == (
        f"{tmp_path / 'fit.json'}: the model needs transformer_heat of transformer.py (SHA-256 "
        f"{sha256[:12]}…), found none of that name; pass the file as it was then: "
        '--library transformer.py, in Python library=load_library("transformer.py")'
    )
    tracked, place = read_turbine(tmp_path, Place(), library), Place()
    assert tracked is not None and tracked.plan.design.library is library
    assert "transformer_heat" in [name for name, _ in tracked.plan.design.mechanisms]
    assert read_turbine(tmp_path, place, LIBRARY) is None and "--library transformer.py" in place.faults[0]
    file.write_text(file.read_text() + "\n# changed since\n")
    with pytest.raises(LibraryAbsent, match=r"found that of transformer\.py \(SHA-256 "):
        read_fit(tmp_path, library=load_library(file))


# -- features, functions that fail later, packages -----------------------------------------------------------
GLOWING = """
def glow(record, time, share=1.0):
    value = record["rain"].value
    return share * np.interp(time, record["rain"].time, value)

import numpy as np
C = hygrokf.cause_of(
    "glowing", thermal=made(lambda p, x, u, q: {"heat_release": p.stove_heat * u.glow}, inputs=("glow",)),
    features={"glow": (glow, "linear")}, NEEDS **WORDS)
"""


def test_an_own_feature_is_an_input(tmp_path: Path) -> None:
    library = load_library(written(tmp_path, GLOWING.replace("NEEDS", "needs=('rain',),")))
    (cause,) = library.own
    assert cause.needs == "rain"
    record = trial_record()
    base = design(record, kind="thermal", library=library)
    wider = extended(base, [("stove", {})], features={"glow": {"share": 2.0}})
    assert wider.model.holds["glow"] == "linear"
    np.testing.assert_allclose(model_inputs(wider, record).timeline.input("glow"), 2.0 * record["rain"].value)
    assert set(wider.to_json()["origins"]) == {"stove", "glow"}
    dry = replace(record, series=tuple(s for s in record.series if s.signal != "rain"))
    assert cause.forms(replace(trial_ground(), record=dry)) == []


def test_a_function_that_fails_on_a_record_is_a_fault_of_its_file(tmp_path: Path) -> None:
    library = load_library(written(tmp_path, GLOWING.replace("NEEDS", "")))
    record = trial_record()
    dry = replace(record, series=tuple(s for s in record.series if s.signal != "rain"))
    base = design(record, kind="thermal", library=library)
    wider = extended(base, [("stove", {})], features={"glow": {}})
    with pytest.raises(
        LibraryFault, match=r"own\.py: cause 'glowing': feature 'glow' fails: KeyError: .*no rain"
    ):
        model_inputs(wider, dry)
    text = "C = hygrokf.Cause('odd', 'a', 'b', 'c', lambda s: [Form('odd', 'f', " \
        "(('oven', {}),))] if 'rain' in s.record else s.none, mechanisms={'oven': " \
        "made(lambda p, x, u, q: {'heat_release': p.oven_heat}, ('oven_heat',), 'oven', ())})"  # fmt: skip
    (cause,) = load_library(written(tmp_path, text, "odd.py")).own
    with pytest.raises(LibraryFault, match=r"odd\.py: cause 'odd': forms fails: AttributeError"):
        cause.forms(replace(trial_ground(), record=dry))


@pytest.fixture
def package(tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An installed package, as far as Python's metadata can see."""
    site = tmp_path / "site"
    info = site / "turbine_causes-2.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: turbine-causes\nVersion: 2.1\n")
    (info / "entry_points.txt").write_text("[hygrokf.causes]\ntransformer = turbine_causes:TRANSFORMER\n")
    (site / "turbine_causes.py").write_text(file.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.syspath_prepend(site)
    yield info
    sys.modules.pop("turbine_causes", None)


def test_a_package_announces_its_cause(package: Path) -> None:
    assert load_library().own == ()
    library = load_library(installed=True)
    assert library.origins == {"transformer_heat": {"package": "turbine-causes", "version": "2.1"}}
    expect_usable(library)
    (package / "entry_points.txt").write_text("[hygrokf.causes]\nall = turbine_causes\n")
    assert [one.name for one in load_library(installed=True).own] == ["transformer_heat"]
    (package / "entry_points.txt").write_text(
        "[hygrokf.causes]\na = turbine_causes:WORDS\nb = turbine_causes:transformer_heat\n"
    )
    with pytest.raises(LibraryFault) as caught:
        load_library(installed=True)
    first, second = caught.value.faults
    assert first.startswith("package turbine-causes (entry point a): cannot be loaded: AttributeError")
    assert "entry point b): expected a Cause or a module with causes, found <function" in second


def test_a_cause_of_a_session_has_its_module_for_an_origin() -> None:
    space: dict = {"__name__": "notebook"}
    exec(compile(documented(), "<cell 1>", "exec"), space)
    library = LIBRARY.with_causes(space["TRANSFORMER"])
    expect_usable(library)
    assert library.origins == {"transformer_heat": {"python": "notebook"}}
    assert library.absent(library.origins) == []
    assert "pass the library that has it" in LIBRARY.absent(library.origins)[0]


def test_discover_refuses_before_the_work() -> None:
    twice = replace(LIBRARY.cause("solar_gain"), meaning="another")
    with pytest.raises(LibraryFault, match="two have the cause name 'solar_gain'"):
        LIBRARY.with_causes(twice)
    idle = cause_of("idle", thermal=lambda: hygrokf.Mechanism("idle"), **WORDS)
    with pytest.raises(LibraryFault, match="mechanism 'idle': expected a parameter with a null"):
        hygrokf.discover(to_record(plant(5, days=3.0)), library=LIBRARY.with_causes(idle))


# -- from a case file to the stored model --------------------------------------------------------------------
def warmed_case(directory: Path, auxiliary: bool = True) -> Path:
    """A synthetic turbine whose transformer warms the cabinet: losses as the load to 1.8, hour by hour
    through a lag."""
    case = write_case(synthetic_turbine(seed=6, days=24), directory)
    rows = [line.split(",") for line in (directory / "cabinet.csv").read_text().splitlines()]
    head, rows = rows[0], rows[1:]
    seconds = np.array([np.datetime64(row[0].rstrip("Z"), "s").astype(float) for row in rows])
    random = np.random.default_rng(9)
    minute = np.arange(seconds[0] - 86400.0, seconds[-1] + 7200.0, 60.0)
    turns = minute[0] + np.cumsum(random.uniform(1.0, 12.0, 900)) * 3600.0
    load = np.where(np.searchsorted(turns, minute) % 2 > 0, 24.0, 5.0)
    drive = 5.0 * (load / 20.0) ** 1.8
    warmer = np.full(len(minute), drive[0])
    for k in range(1, len(minute)):
        warmer[k] = warmer[k - 1] + (drive[k] - warmer[k - 1]) / 90.0
    added = np.interp(seconds, minute, warmer)
    degrees = np.array([float(row[1] or "nan") for row in rows])
    factor = np.exp(
        17.62 * degrees / (243.12 + degrees) - 17.62 * (degrees + added) / (243.12 + degrees + added)
    )
    for row, more, less in zip(rows, added, factor, strict=True):
        row[1] = f"{float(row[1]) + more:.1f}" if row[1] else ""
        row[2] = f"{float(row[2]) * less:.1f}" if row[2] else ""
    (directory / "cabinet.csv").write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")
    if auxiliary:
        ends = minute[10::10]
        means = [load[i * 10 : i * 10 + 10].mean() for i in range(len(ends))]
        stamps = ends.astype("datetime64[s]").astype(str)
        table = [f"{t}Z,{v:.2f}" for t, v in zip(stamps, means, strict=True)]
        (directory / "own_power.csv").write_text("\n".join(["time,P_kW", *table]) + "\n")
        stated = '\n[[source]]\nfile = "own_power.csv"\ntime = "time"\nstamp = "end"\n'
        stated += 'signals.auxiliary_power = { column = "P_kW", unit = "kW" }\n'
        case.write_text(case.read_text() + stated)
    return case


@pytest.mark.slow
def test_the_whole_way_from_a_case_to_a_simulation(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("hygrokf.modelling.library.LIBRARY", LIBRARY.only("solar_gain", "wall_thermal_mass"))
    case, out = warmed_case(tmp_path / "turbine"), tmp_path / "found"

    def told(*arguments: object) -> tuple[int, str]:
        """(exit status, what was said)."""
        capsys.readouterr()
        status = main([str(a) for a in arguments])
        said = capsys.readouterr()
        return status, said.out + said.err

    text = (
        "C = hygrokf.cause_of('stove', thermal=made(stove, inputs=('heater_power', 'auxiliary_power')), "
        "**WORDS)"
    )
    other = written(tmp_path, text)
    status, said = told("discover", case, "--out", out, "--library", file, "--library", other)
    assert status == 0
    assert (
        "note: stove was not tried: this record cannot show it; it needs auxiliary_power, heater_power"
        in said
    )
    data = json.loads((out / "discovery.json").read_text())
    assert [one["cause"] for one in data["causes"]] == ["transformer_heat"]
    (cause,) = data["causes"]
    assert cause["own"]["remedy"].startswith("ventilate the transformer's room")
    assert 3.5 < cause["parameters"]["transformer_gain"]["value"] < 6.5
    gain = data["gains"][0]
    assert (gain["quantity"], gain["period"]) == ("temperature", "validation")
    assert gain["rmse_after"] < 0.85 * gain["rmse_before"]

    status, said = told("simulate", out, case, "--out", tmp_path / "course.csv")
    assert status == 2 and not (tmp_path / "course.csv").exists()
    assert "the model needs transformer_heat of transformer.py (SHA-256 " in said
    assert "found none of that name; pass the file as it was then: --library transformer.py" in said
    status, said = told("simulate", out, case, "--out", tmp_path / "course.csv", "--library", file)
    assert status == 0 and "instants written" in said
    status, said = told("evaluate", out, case, "--library", file, "--json")
    assert status == 0 and "auxiliary_power" not in said
    assert told("report", out)[0] == 0

    file.write_text(file.read_text() + "\n# changed since\n")
    status, said = told("evaluate", out, case, "--library", file)
    assert status == 2 and "found that of transformer.py (SHA-256 " in said
    stored = json.loads((out / "fit.json").read_text())
    stored["design"]["origins"]["transformer_heat"] = {"package": "turbine-causes", "version": "2.1"}
    (out / "fit.json").write_text(json.dumps(stored))
    status, said = told("evaluate", out, case)
    assert status == 2 and "of the package turbine-causes 2.1, found none of that name; install that" in said
    stored["design"]["origins"] = {"transformer_heat": "a file"}
    (out / "fit.json").write_text(json.dumps(stored))
    with pytest.raises(ResultFault, match="damaged") as caught:
        read_fit(out)
    assert not isinstance(caught.value, LibraryAbsent)


@pytest.mark.parametrize(
    "command", ["discover {case} --out {out}", "simulate {case} {case} --out {out}/x.csv"]
)
def test_a_faulty_library_is_told_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture, command: str
) -> None:
    case = write_case(synthetic_turbine(seed=7, days=3), tmp_path / "turbine")
    (tmp_path / "own.py").write_text("print('hello')\n")
    line = command.format(case=case, out=tmp_path if "simulate" in command else tmp_path / "made")
    assert main([*line.split(), "--library", str(tmp_path / "own.py")]) == 2
    said = capsys.readouterr()
    assert said.err.endswith(
        "hygrokf: library of causes: 1 fault\n  1. own.py: expected a hygrokf.Cause at the top level, "
        "found none: define NAME = hygrokf.cause_of(…), docs/how_to/own_cause.md\n"
    )
    assert said.out == "" and not (tmp_path / "made").exists()
