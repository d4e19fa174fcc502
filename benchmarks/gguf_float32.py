"""The bundled model's weights as a GGUF file in float32, for llama.cpp: the very numbers that our engine computes with.

    python -m benchmarks.gguf_float32 smollm2-135m-f32.gguf [--model smollm2-135m]

The bundled model is a quantised GGUF file, which is dequantised when it is first used (`agentspec.llm.models`); here
the same is written back, metadata and tokenizer as they were (SmolLM2-135M: 540 MB). It needs `gguf`. Of a model in
another form, llama.cpp's own `convert_hf_to_gguf.py --outtype f32` makes such a file.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from agentspec.llm.models import BUNDLED

_WRITTEN_ANEW = ("GGUF.", "general.architecture", "general.file_type", "general.quantization_version")


def write_float32(source: Path, target: Path) -> None:
    """Write the GGUF file `source` to `target` with all tensors in float32: complete or not at all."""
    from gguf import GGUFReader, GGUFValueType, GGUFWriter, LlamaFileType
    from gguf.quants import dequantize

    reader = GGUFReader(source)
    part = target.with_name(f".{target.name}.part")
    writer = GGUFWriter(part, reader.fields["general.architecture"].contents())
    writer.add_file_type(LlamaFileType.ALL_F32)
    for name, field in reader.fields.items():
        if not name.startswith(_WRITTEN_ANEW):
            kind = field.types[0]
            sub = field.types[-1] if kind == GGUFValueType.ARRAY else None
            writer.add_key_value(name, field.contents(), kind, sub_type=sub)
    for tensor in reader.tensors:
        writer.add_tensor(tensor.name, dequantize(tensor.data, tensor.tensor_type).astype("float32"))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    os.replace(part, target)


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("target", type=Path)
    parser.add_argument("--model", default="smollm2-135m", choices=sorted(BUNDLED))
    options = parser.parse_args()
    source = BUNDLED[options.model].find()
    if source is None:
        parser.error(f"{options.model} is not installed; {BUNDLED[options.model].remedy}")
    write_float32(source, options.target)
    print(f"{options.target}: {options.target.stat().st_size / 2**20:.0f} MiB")


if __name__ == "__main__":
    main()
