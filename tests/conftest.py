"""What holds for every test."""

import signal

# a shell that runs the suite in the background has it ignore Ctrl-C, and so would what tests start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
