import threading
from concurrent.futures import wait

from threadpoolctl import threadpool_info, threadpool_limits

from diagnostics.threads import _UNDER_WAY, one_thread


def of_blas() -> set[int]:
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}


def test_blas_has_one_thread_from_the_first_that_asks_for_it_to_the_last_that_leaves():
    wait(tuple(_UNDER_WAY))  # what monitors of other tests evaluate
    inside = threading.Event()
    leaves = threading.Event()

    def other() -> None:
        with one_thread():
            inside.set()
            leaves.wait(60)

    with threadpool_limits(2, "blas"):
        thread = threading.Thread(target=other)
        with one_thread(), one_thread():
            thread.start()
            assert inside.wait(60)
        assert of_blas() == {1}  # the other one has not left
        leaves.set()
        thread.join()
        assert of_blas() == {2}
