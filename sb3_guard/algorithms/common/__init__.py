"""What the algorithms share: the trust-region base and the mathematics it uses."""
