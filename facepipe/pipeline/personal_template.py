"""Personal templates: made by `facepipe personal-template`, and made again from their recipes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from facepipe.kinds import Watch
from facepipe.pipeline.rebuild_stage import read_stage_recipe
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.database import load_database
from facepipe.processors.rebuild import PersonalTemplate, PersonalTemplateOptions, Template
from facepipe.processors.rebuild.author_personal import VERB, AuthorPersonal, PersonalReport, personal_recipe
from facepipe.processors.rebuild.scan_input import named
from facepipe.stage import open_face


@dataclass(frozen=True, kw_only=True)
class PersonalJob:
    """A personal template to make."""

    neutral: Path
    template: Path
    database: Path | None
    out: Path
    options: PersonalTemplateOptions = field(default_factory=PersonalTemplateOptions)
    flatten: bool = False


def cook(path: Path, watch: Watch) -> Cooked:
    """Carry shapes over again, in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read or used
    """
    recipe = read_stage_recipe(path, VERB)
    job = PersonalJob(
        neutral=recipe.file("neutral"),
        template=recipe.file("template"),
        database=recipe.optional("database"),
        out=path,
        options=recipe.options(PersonalTemplateOptions),
        flatten=recipe.standalone,
    )
    return Cooked(report=make(job, watch))


def make(job: PersonalJob, watch: Watch) -> PersonalReport:
    """Read, carry over, author, save.

    :raises FacepipeError: what can't be read, used or written
    """
    face = open_face(job.neutral)
    template = Template.of(open_face(job.template).parts(), str(job.template))
    database = None if job.database is None else load_database(job.database)
    author = AuthorPersonal(template=template, make=PersonalTemplate(options=job.options), database=database)
    files = (job.neutral, job.template, job.database)
    recipe = personal_recipe(face.parts().recipe, *files, out=job.out, options=job.options)
    with (
        face.deriving(job.out, flatten=job.flatten) as derived,
        named(job.neutral),
        watch("shapes", author.count) as bar,
    ):
        return author(derived, recipe=recipe, done=bar.update)
