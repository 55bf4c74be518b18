"""Pure geometry of mirror cameras: rigid transforms, camera models, rigs and panoramas."""
