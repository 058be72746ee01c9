import gc

from stream_dmr.cli.shared_options import importing


def test_garbage_is_looked_for_again_afterwards():
    with importing():
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.unfreeze()
