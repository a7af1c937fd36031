"""Visibilities of one component of the sky through one instrument, simulated in independent pieces."""

from __future__ import annotations

from dataclasses import asdict
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.instrument.antenna_beams import make_beams
from calstudy.instrument.interface import model_of
from calstudy.instrument.telescope import make_template
from calstudy.power.cosmology import make_cosmology
from calstudy.simulate.chunks import Chunk, check_interpolation, plan_chunks
from calstudy.simulate.interface import simulate_with
from calstudy.simulate.nodes import Accuracy
from calstudy.sky.eor import EorField
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import Eor

if TYPE_CHECKING:
    from pyradiosky import SkyModel

    from calstudy.instrument.settings import InstrumentSettings
    from calstudy.simulate.settings import SimulationSettings
    from calstudy.sky.settings import Diffuse, Foregrounds

SMOOTH_SPECTRA = ("flat", "spectral_index")
CHECKED = 2
"""Number of integrations, and of channels, at which interpolated visibilities are compared with direct ones."""


class Component:
    """Sources or the EoR seen by the instrument as built; expensive parts are made on demand.

    `template` is the observation with the nominal antenna positions, which data files have. `as_built` has the true
    positions, for which it is simulated. The cosmology converts the P(k) of the EoR to brightness. Diffuse emission is
    added to sources.
    """

    def __init__(
        self,
        instrument: InstrumentSettings,
        simulation: SimulationSettings,
        sky: Foregrounds | Eor,
        cosmology: str,
        diffuse: Diffuse | None = None,
    ) -> None:
        self._sky, self._cosmology, self._diffuse = sky, cosmology, diffuse
        self.is_eor = isinstance(sky, Eor)
        self.instrument, self.simulation = instrument, simulation
        self.template = make_template(instrument)
        moved = instrument.as_built.positions.scatter > 0
        self.as_built = make_template(instrument, as_built=True) if moved else self.template
        self.beam = make_beams(instrument, self.template.telescope.Nants)
        self.engine = simulation.engine
        self.stand_ins = self._notes(None)

    def _notes(self, sky: str | None) -> list[str]:
        return [note for note in (sky, self.beam.stand_in, self.instrument.as_built.note) if note]

    @cached_property
    def _field(self) -> EorField | None:
        if not isinstance(self._sky, Eor):
            return None
        return EorField(self._sky, self.template.freq_array, make_cosmology(self._cosmology))

    @cached_property
    def _foregrounds(self) -> SkyModel:
        if isinstance(self._sky, Eor):
            raise TypeError("the EoR has no foregrounds")
        foregrounds = make_foregrounds(self._sky, self.template.freq_array, self._diffuse)
        self.stand_ins = self._notes(foregrounds.stand_in)
        return foregrounds.sky

    @cached_property
    def accuracy(self) -> Accuracy:
        """Tolerance of the interpolation, and whether beam and sky are smooth in frequency."""
        beams = [self.instrument.beam, *(group.beam for group in self.instrument.antenna_beams.values())]
        smooth_beam, nodes = all(model_of(beam).smooth for beam in beams), self.simulation.nodes
        if self.is_eor:
            return nodes.for_eor(smooth_beam)
        return nodes.for_foregrounds(smooth_beam, smooth_sky=self._foregrounds.spectral_type in SMOOTH_SPECTRA)

    @cached_property
    def chunks(self) -> list[Chunk]:
        """Chunks of the simulation, at most as many as the settings ask for."""
        return plan_chunks(self.as_built, self.accuracy, self.simulation.pieces(self.is_eor))

    def sky(self, channels: slice | np.ndarray) -> SkyModel:
        """Return the sky; for the EoR only at the given channels."""
        return self._foregrounds if self._field is None else self._field.sky(channels)

    def interpolation_error(self, cube: np.ndarray) -> dict[str, Any] | None:
        """Compare interpolated visibilities, (Ntimes, Nbls, Nfreqs, Npols), Jy, with directly simulated ones.

        Return None if nothing is interpolated.
        """
        if not self.accuracy.tolerance:
            return None
        # The channels of the EoR are independent, so only the last ones are drawn again.
        channels = slice(-CHECKED, None) if self.is_eor else slice(None)
        sky = self.sky(np.arange(self.template.Nfreqs)[channels])
        simulate = partial(simulate_with, self.engine, sky, self.beam)
        return asdict(
            check_interpolation(simulate, self.as_built, cube, self.chunks[0], channels=channels, count=CHECKED)
        )
