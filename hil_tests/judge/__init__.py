"""The judge: what a unit must send and accept, worked out from its definition a second time.

A tester that decodes with the product's own codec passes every error that both ends share: a wrong polynomial,
swapped escapes, a scale applied twice. The judge therefore encodes requests and decodes answers with its own code, one
module per mechanism, each written from a public description that is named in its first lines:

    request ──► rows ──► header or dialect ──► check ──► framing ──► line          (serial)
    request ──► rows ──► CAN ID ──► segments ──► frames                            (CubeSpace on CAN)
    entry   ──► rows ──► SDO transfer, PDO mapping ──► frames                      (CANopen)

Rules of this package:

- It imports nothing of `starhil.protocol`, except in `definition`, which copies the parsed definition into the
  judge's own types: names, types, order and scales of the fields. Offsets, bit positions, sizes, limits and
  default values follow from these and are worked out here.
- It is strict and slow: one way to write each message, no table that a simple loop can replace, no recovery. What
  it cannot read is `malformed`; it never guesses.
- docs/rules.md lists what it deliberately shares with the product: the reading of the TOML files, and the framings
  and checks that a unit's own plugin defines.
"""
