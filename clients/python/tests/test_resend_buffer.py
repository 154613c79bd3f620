"""The buffer of unacknowledged items against a model of a server."""

import random

import pytest

from sightfix._resend_buffer import ResendBuffer


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("must_acknowledge", [False, True])
def test_every_item_is_sent_until_it_is_done(seed: int, *, must_acknowledge: bool) -> None:
    draw = random.Random(seed)  # noqa: S311
    buffer: ResendBuffer[int] = ResendBuffer(must_acknowledge=must_acknowledge)
    awaited: set[int] = set()
    pushed = sent = first_answers = 0
    for _ in range(300):
        match draw.randrange(6):
            case 0 | 1:
                pushed += 1
                assert buffer.push(pushed) == pushed
            case 2 if buffer.has_next():
                seq, item = buffer.take_next()
                assert seq == item > buffer.resume_after_seq
                assert seq not in awaited
                awaited.add(seq)
                sent = max(sent, seq)
            case 3 if awaited:
                seq = draw.choice(sorted(awaited))
                awaited.discard(seq)
                first_answers += buffer.answer(seq)
                assert not buffer.answer(seq)
            case 4 if must_acknowledge:
                buffer.acknowledge(draw.randint(0, sent))
            case 5 if draw.random() < 0.2:
                awaited.clear()
                sent = buffer.acknowledged_seq
                buffer.rewind()
        assert buffer.awaited == len(awaited)
        assert buffer.last_seq == pushed
    # A server that then answers and acknowledges everything empties the buffer.
    buffer.rewind()
    while buffer.has_next():
        first_answers += buffer.answer(buffer.take_next()[0])
    buffer.acknowledge(pushed)
    assert len(buffer) == 0
    if not must_acknowledge:
        assert first_answers == pushed


def test_dropped_answers_free_the_buffer() -> None:
    buffer: ResendBuffer[str] = ResendBuffer(must_acknowledge=False)
    for item in "abcde":
        buffer.push(item)
        buffer.take_next()
    buffer.answer(1)
    buffer.drop_answers(2, 4)
    assert (buffer.awaited, buffer.lost_answers, buffer.resume_after_seq) == (2, 2, 3)
    buffer.drop_answers(9, 4)
    assert buffer.lost_answers == 2, "there was none left before it"
