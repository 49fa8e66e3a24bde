"""Which topics of a recording can be published here: those whose message type is installed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from msg_adapters.errors import MessageError
from msg_adapters.factory import message_class
from splatam_core.datasets.bag.recording import RecordedTopic, Recording


@dataclass(frozen=True, slots=True)
class PlayableTopics:
    """The topics of a recording.

    Attributes:
        topics: by name, those that can be published.
        skipped: name to reason, those that cannot.
    """

    topics: Mapping[str, RecordedTopic]
    skipped: Mapping[str, str]


def find_playable(recording: Recording) -> PlayableTopics:
    """Sort the topics of a recording into those that can be published and those that cannot."""
    reasons = {name: _reason_to_skip(topic) for name, topic in recording.topics.items()}
    return PlayableTopics(
        {name: topic for name, topic in recording.topics.items() if reasons[name] is None},
        {name: reason for name, reason in reasons.items() if reason is not None},
    )


def _reason_to_skip(topic: RecordedTopic) -> str | None:
    if len(topic.type_names) > 1:
        return f'it has several types: {", ".join(topic.type_names)}'
    try:
        message_class(topic.type_name)
    except MessageError as error:
        return str(error)
    return None
