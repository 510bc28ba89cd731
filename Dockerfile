# rl2grid with everything to train, evaluate and draw:
#   docker build -t rl2grid .
#   docker run --rm -v "$PWD/out:/out" rl2grid demo --output /out/demo
FROM python:3.11-slim
WORKDIR /opt/rl2grid
# The build of PyTorch for processors; the default one brings gigabytes of CUDA libraries.
COPY constraints.txt .
RUN pip install --no-cache-dir -c constraints.txt torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu --extra-index-url https://pypi.org/simple
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY src src
RUN pip install --no-cache-dir -c constraints.txt ".[train,analysis]"
# Months and compiled code are kept here: mount it to keep them from one container to the next.
ENV RL2GRID_DATA=/data XDG_CACHE_HOME=/data/cache OPENBLAS_NUM_THREADS=1
VOLUME /data
WORKDIR /out
ENTRYPOINT ["rl2grid"]
CMD ["--help"]
