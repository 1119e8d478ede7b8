"""What training and evaluation need besides an algorithm: vector envs, monitor, callbacks."""
