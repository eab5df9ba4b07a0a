from irlos_pipe.api.reducing import Reduction as Reduction
from irlos_pipe.api.reducing import calibrate as calibrate
from irlos_pipe.api.reducing import diagnose as diagnose
from irlos_pipe.api.reducing import lift as lift
from irlos_pipe.api.reducing import read_recordings as read_recordings
from irlos_pipe.api.running import open_run as open_run
from irlos_pipe.api.running import run as run
from irlos_pipe.conventions.errors import ConfigurationError as ConfigurationError
from irlos_pipe.conventions.errors import InputDataError as InputDataError
from irlos_pipe.estimate.focus import Focus as Focus
from irlos_pipe.instrument.instrument import load_instrument as load_instrument
from irlos_pipe.optics.psf import PsfModel as PsfModel
from irlos_pipe.optics.psf_settings import PsfSettings as PsfSettings
from irlos_pipe.optics.zernike import noll_nm as noll_nm
from irlos_pipe.product.storage import read_product as read_product
from irlos_pipe.recipe import load_recipe as load_recipe
from irlos_pipe.reference.lookup import explain as explain
from irlos_pipe.report.build import figures as figures

__version__: str
HOMES: dict[str, str]
