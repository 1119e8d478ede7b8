"""The script ``sb3-guard``: Ctrl-C ends it without a traceback, also while Python still imports."""

import signal


def main() -> int:
    """
    Run the command line of the process.

    :return: exit status
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is signal.default_int_handler:  # not ignored, as in the background of a shell
        # Extension modules turn an exception within their import into an ImportError.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from sb3_guard import cli

    signal.signal(signal.SIGINT, handler)
    return cli.main()
