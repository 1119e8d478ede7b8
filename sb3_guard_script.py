"""The script ``sb3-guard``: Ctrl-C ends it without a traceback, also while Python still imports."""


def main() -> int:
    """
    Run the command line of the process.

    :return: exit status
    """
    try:
        from sb3_guard import cli

        return cli.main()
    except KeyboardInterrupt:
        return 130
