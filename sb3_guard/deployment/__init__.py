"""The way from a trained agent to a robot: one ONNX file, and a contract of its inputs and outputs.

``policies.py`` says in torch's operators how an agent acts, ``observations.py``
how its observations are normalised; ``onnx_file.py`` writes them, and ``contract.py`` what the file
expects.
"""
