"""What the bench kernel changes in the sources of Linux before it is compiled, and why."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Edit:
    """In `file`, below the kernel's tree, `found` stands exactly once and becomes `put`."""

    file: str
    found: str
    put: str


EDITS = (
    # The host's ptrace takes a thread's FPU registers back only whole (EFAULT otherwise), and on a processor with AMX they
    # are 11 008 bytes: `userspace - ptrace set fp regs failed, errno = 14`, and the first process of the guest is dead.
    # The same buffer lies below the kernel stack, which is why the configuration asks for CONFIG_KERNEL_STACK_ORDER=3.
    Edit(
        "arch/x86/um/user-offsets.c",
        "DEFINE_LONGS(HOST_FP_SIZE, 2696);",
        "DEFINE_LONGS(HOST_FP_SIZE, 12288);",
    ),
)


class EditError(RuntimeError):
    """The sources are not those that an edit was made for."""


def apply_edits(tree: Path, edits: tuple[Edit, ...] = EDITS) -> None:
    """Change the sources below `tree`. Raises EditError."""
    for edit in edits:
        path = tree / edit.file
        text = path.read_text() if path.is_file() else ""
        if text.count(edit.found) != 1:
            raise EditError(
                f"{edit.file}: `{edit.found}` found {text.count(edit.found)} times, expected once"
            )
        path.write_text(text.replace(edit.found, edit.put))
