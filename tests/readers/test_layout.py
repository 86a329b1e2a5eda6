"""Fields of serialised messages: what the deserialiser of rosbags reads, for every type of ROS 1 and ROS 2."""

import keyword
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_files import ROS1, ROS2, build
from rosbags.interfaces import Nodetype

from bayes_impedance.readers.bags.layout import LONGEST_ARRAY, Decoder, MalformedError, Walker

STORES = {"ros1": ROS1, "little": ROS2, "big": ROS2}
TYPES = [(form, kind) for form, store in STORES.items() for kind in sorted(store.fielddefs)]


def random_content(store, kind, rng):
    """Content of a message of any type: arrays of any length, numbers of any size, text in and beyond ASCII."""

    def value(node, what):
        if node == Nodetype.NAME:
            return random_content(store, what, rng)
        if node == Nodetype.BASE:
            return scalar(what[0])
        element, size = what
        return [value(*element) for _ in range(size if node == Nodetype.ARRAY else rng.integers(0, 4))]

    def scalar(name):
        if name == "string":
            return "".join(rng.choice(list("aé∞ "), size=rng.integers(0, 6)))
        if name == "bool":
            return bool(rng.integers(2))
        if name.startswith("float"):
            return float(np.dtype(name).type(rng.normal()))
        limits = np.iinfo({"byte": "int8", "char": "uint8"}.get(name, name))
        return int(rng.integers(limits.min, limits.max, endpoint=True, dtype=limits.dtype))

    return {name: value(*description) for name, description in store.fielddefs[kind][1] if name != EMPTY}


EMPTY = "structure_needs_at_least_one_member"


def serialised(form, kind, content):
    store = STORES[form]
    message = build(store, kind, {EMPTY: 0} | content if store.fielddefs[kind][1][0][0] == EMPTY else content)
    if form == "ros1":
        return bytes(store.serialize_ros1(message, kind))
    return bytes(store.serialize_cdr(message, kind, little_endian=form == "little"))


def read_by_library(form, kind, raw):
    """Every number by its path, from the object that rosbags makes of the message: the slow way."""
    store = STORES[form]
    message = (store.deserialize_ros1 if form == "ros1" else store.deserialize_cdr)(raw, kind)
    numbers = {}

    def visit(path, node, what, value):
        if node == Nodetype.NAME:
            for name, description in store.fielddefs[what][1]:
                if form != "ros1" or name != EMPTY:
                    attribute = f"{name}_" if keyword.iskeyword(name) else name
                    visit(f"{path}.{name}" if path else name, *description, getattr(value, attribute))
        elif node == Nodetype.BASE:
            if what[0] != "string":
                numbers[path] = float(value)
        else:
            for index, item in enumerate(value):
                visit(f"{path}[{index}]", *what[0], item)

    visit("", Nodetype.NAME, kind, message)
    return numbers


def walked(form, kind, raw):
    return Walker(raw, STORES[form].fielddefs, form != "ros1").layout(kind)


@pytest.mark.parametrize(("form", "kind"), TYPES, ids="-".join)
def test_every_number_of_every_type_is_what_the_library_reads(form, kind):
    rng = np.random.default_rng(0)
    raws = [serialised(form, kind, random_content(STORES[form], kind, rng)) for _ in range(6)]
    truths = [read_by_library(form, kind, raw) for raw in raws]
    columns = sorted(set().union(*truths))
    values, present = Decoder(kind, STORES[form].fielddefs, form != "ros1", columns).decode(raws)
    for index, (raw, truth) in enumerate(zip(raws, truths, strict=True)):
        assert set(walked(form, kind, raw).columns()) == set(truth)
        assert [column for column, there in zip(columns, present[:, index], strict=True) if there] == sorted(
            truth
        )
        for column, value in truth.items():
            np.testing.assert_array_equal(values[columns.index(column), index], value)


@pytest.mark.parametrize("form", STORES)
@settings(max_examples=60, derandomize=True, deadline=None)
@given(
    messages=st.lists(
        st.tuples(st.sampled_from(["", "a", "joint"]), st.lists(st.floats(allow_nan=False), max_size=4)),
        max_size=12,
    )
)
def test_messages_of_any_lengths_in_any_order_decode_as_one_by_one(form, messages):
    kind = "sensor_msgs/msg/JointState"
    raws = [serialised(form, kind, {"name": [name], "effort": effort}) for name, effort in messages]
    values, present = Decoder(
        kind, STORES[form].fielddefs, form != "ros1", ["effort[0]", "effort[2]"]
    ).decode(raws)
    for row, at in enumerate((0, 2)):
        efforts = [effort for _, effort in messages]
        np.testing.assert_array_equal(present[row], [len(effort) > at for effort in efforts])
        np.testing.assert_array_equal(
            values[row], [effort[at] if len(effort) > at else np.nan for effort in efforts]
        )


def test_messages_of_one_size_with_other_lengths_are_told_apart():
    # Eight characters more in a name, one number less: as many bytes.
    contents = [{"name": [""], "effort": [1.0, 2.0]}, {"name": ["x" * 8], "effort": [3.0]}]
    kind = "sensor_msgs/msg/JointState"
    raws = [serialised("ros1", kind, content) for content in contents]
    assert len(raws[0]) == len(raws[1])
    values, present = Decoder(kind, ROS1.fielddefs, False, ["effort[0]", "effort[1]"]).decode(raws)
    assert values[0].tolist() == [1.0, 3.0]
    assert present[1].tolist() == [True, False]


@pytest.mark.parametrize("form", STORES)
@settings(max_examples=60, derandomize=True, deadline=None)
@given(data=st.data())
def test_damaged_bytes_are_refused_or_read_as_the_library_reads_them(form, data):
    kind = "sensor_msgs/msg/JointState"
    raw = bytearray(serialised(form, kind, {"name": ["a", "bcd"], "position": [1.0, 2.0], "effort": [3.0]}))
    for at in data.draw(st.lists(st.integers(0, len(raw) - 1), max_size=3)):
        raw[at] = data.draw(st.integers(0, 255))
    raw = bytes(raw[: data.draw(st.integers(0, len(raw)))])
    try:
        columns = list(walked(form, kind, raw).columns())
        values, _ = Decoder(kind, STORES[form].fielddefs, form != "ros1", columns).decode([raw])
    except MalformedError:
        return
    try:
        truth = read_by_library(form, kind, raw)
    except Exception:
        return  # such as text that is no UTF-8, which does not concern us
    np.testing.assert_array_equal(values[:, 0], [truth[column] for column in columns])


BASE, NAME, ARRAY, SEQUENCE = Nodetype.BASE, Nodetype.NAME, Nodetype.ARRAY, Nodetype.SEQUENCE
NUMBER = (BASE, ("float64", 0))


@pytest.mark.parametrize(
    ("definitions", "raw", "reason"),
    {
        "sequence of 2^31 numbers": ({"m": [("x", (SEQUENCE, (NUMBER, 0)))]}, b"\0\0\0\x80", "an end within"),
        "array of 2^31 numbers": ({"m": [("x", (ARRAY, (NUMBER, 2**31)))]}, b"", "an end within"),
        "2^31 empty messages": (
            {"m": [("x", (SEQUENCE, ((NAME, "n"), 0)))], "n": []},
            b"\0\0\0\x80",
            "more than 100000 fields",
        ),
        "a message in itself": ({"m": [("x", (NAME, "m"))]}, b"", "nested without end"),
        "an unknown type": ({"m": [("x", (NAME, "n"))]}, b"", "no definition of the type n"),
        "a type beyond us": (
            {"m": [("x", (BASE, ("wstring", 0)))]},
            b"",
            "type wstring, which is not supported",
        ),
        "bytes left over": ({"m": [("x", NUMBER)]}, bytes(9), "9 bytes where 8 make up the message"),
        "no bytes": ({"m": [("x", NUMBER)]}, b"", "0 bytes, an end within the message"),
    }.values(),
)
def test_what_is_no_message_is_refused_before_memory_is_taken(definitions, raw, reason):
    with pytest.raises(MalformedError, match=reason):
        Walker(raw, {name: ([], fields) for name, fields in definitions.items()}, cdr=False).layout("m")


@pytest.mark.parametrize("raw", [b"", b"\0\7\0\0", b"{}"])
def test_other_encapsulations_of_cdr_are_refused(raw):
    with pytest.raises(MalformedError, match="where CDR begins with 00 00 or 00 01"):
        Walker(raw, ROS2.fielddefs, cdr=True).layout("geometry_msgs/msg/Pose")


def test_elements_of_long_arrays_are_no_columns():
    kind = "std_msgs/msg/Float64MultiArray"
    for n in (LONGEST_ARRAY, LONGEST_ARRAY + 1):
        layout = walked("ros1", kind, serialised("ros1", kind, {"data": np.zeros(n)}))
        elements = [column for column in layout.columns() if re.match(r"data\[", column)]
        assert len(elements) == (n if n == LONGEST_ARRAY else 0)
