import threading

import pytest

from torchrefract import _threads
from torchrefract._threads import share


@pytest.fixture(params=["torch's", "ours"])
def of_threads(request, monkeypatch) -> None:
    """Whose threads there are."""
    if request.param == "ours":
        monkeypatch.setattr(_threads, "_torchs", lambda: None)
    elif _threads._torchs() is None:
        pytest.skip("needs a torch that works with OpenMP's threads by the name that GNU's library gives them")


@pytest.mark.usefixtures("of_threads")
@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize(("count", "least"), [(0, 1), (1, 1), (7, 3), (1000, 1), (1000, 400), (10, 100)])
def test_every_part_is_done_once(threads, count, least, on_threads):
    on_threads(threads)
    done, lock = [0] * count, threading.Lock()

    def work(start: int, stop: int) -> None:
        with lock:
            for i in range(start, stop):
                done[i] += 1

    share(work, count, least=least)
    assert done == [1] * count


@pytest.mark.usefixtures("of_threads")
def test_several_threads_are_at_work(on_threads):
    on_threads(2)
    both, names = threading.Barrier(2, timeout=20), set[int]()

    def work(*_: int) -> None:
        names.add(threading.get_ident())
        both.wait()  # no part ends before another thread has begun one

    share(work, 8, least=1)
    assert len(names) == 2


@pytest.mark.usefixtures("of_threads")
@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_on_any_thread_is_raised(threads, on_threads):
    on_threads(threads)

    def work(start: int, stop: int) -> None:
        if start <= 70 < stop:
            raise ValueError("seventy")

    with pytest.raises(ValueError, match="seventy"):
        share(work, 100, least=1)


@pytest.mark.usefixtures("of_threads")
def test_threads_of_a_program_may_share_work_at_the_same_time(on_threads):
    on_threads(2)
    sums = [0] * 4

    def run(i: int) -> None:
        lock = threading.Lock()

        def work(start: int, stop: int) -> None:
            with lock:
                sums[i] += sum(range(start, stop))

        for _ in range(50):
            share(work, 100, least=1)

    workers = [threading.Thread(target=run, args=(i,)) for i in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert sums == [50 * 4950] * 4
