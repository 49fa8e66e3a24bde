"""Generators of damage to bytes and to trees of JSON."""

from __future__ import annotations

import json

from hypothesis import strategies as st

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.integers(-(10**400), 10**400) | st.floats() | st.text(max_size=8)
    | st.sampled_from(['', '.', '../..', 'x' * 5000, '\0', 'NaN', '1e400']),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3), max_leaves=5,
)  # fmt: skip
WORDS = st.sampled_from(
    ['nan', 'inf', '-1', '0', '1e400', '1e-400', '9' * 5000, '', '\0', '\ufeff', '"', "'", '\\', ';', '#', '# lost', '\t', 'é', '٣',
     '²', '1_000', '0x10', '+', '- - -', '{', '[' * 3000, '&a [*a]', '*a', '!!python/object:os.system', '2020-13-45', '1:99', '\r',
     '\x85', '\u2028', '9223372036854775808', '-9223372036854775809', 'true', '~', 'null', ',' * 40]
)  # fmt: skip


@st.composite
def damage(draw: st.DrawFn, data: bytes) -> bytes:
    """The bytes, changed in a few places."""
    result = bytearray(data)
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        at = draw(st.integers(0, len(result)))
        kind = draw(st.sampled_from(['flip', 'cut', 'drop', 'insert', 'word', 'repeat', 'line']))
        if kind == 'flip' and at < len(result):
            result[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == 'cut':
            del result[at:]
        elif kind == 'drop':
            del result[at : at + draw(st.integers(1, 20))]
        elif kind == 'insert':
            result[at:at] = draw(st.binary(max_size=20))
        elif kind == 'repeat':
            result[at:at] = result[: draw(st.integers(0, len(result)))]
        else:
            begin = result.rfind(b'\n', 0, at) + 1 if kind == 'line' else at
            end = result.find(b'\n', at) if kind == 'line' else at + draw(st.integers(0, 8))
            result[begin : max(begin, end)] = draw(WORDS).encode()
    return bytes(result)


@st.composite
def json_damage(draw: st.DrawFn, data: bytes) -> bytes:
    """A JSON object of which some values, at any depth, are replaced."""
    tree = json.loads(data)
    for _ in range(draw(st.sampled_from([1, 1, 2, 3]))):
        node, key = tree, draw(st.sampled_from(sorted(tree)))
        while isinstance(node[key], dict) and node[key] and draw(st.booleans()):
            node, key = node[key], draw(st.sampled_from(sorted(node[key])))
        if draw(st.booleans()):
            node[key] = draw(JSON)
        else:
            del node[key]
        if not tree:
            break
    return json.dumps(tree).encode()
