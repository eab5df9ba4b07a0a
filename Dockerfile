# docker build -t irlos .
# docker run --rm -v "$PWD:/work" irlos demo
ARG PYTHON=3.12
FROM python:${PYTHON}-slim
# Another index gives another build of PyTorch: --build-arg TORCH_INDEX=URL, see the Makefile.
ARG TORCH_INDEX=
COPY . /source
RUN python -m pip install --no-cache-dir -c /source/constraints.txt \
        ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} '/source[paper]' \
    && rm -rf /source
WORKDIR /work
ENTRYPOINT ["irlos"]
CMD ["--help"]
