# impslam for amd64 and arm64:
#   docker build -t impslam .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" impslam run mylog.mcap -o office
#   docker run --rm -it --network host impslam robot --virtual
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN python -m venv /venv && /venv/bin/pip install --no-cache-dir ".[robot,web]"

FROM python:3.12-slim
COPY --from=build /venv /venv
# Any user may keep accounts and compiled code there; -v keeps them beyond a container.
ENV HOME=/home/imp NUMBA_CACHE_DIR=/home/imp/numba PATH=/venv/bin:$PATH
# Compile once, for the processor that the image is built on: another one compiles again. The demo compiles the
# landmark filter, the run the pose graph, and the virtual robot its emulators.
RUN mkdir -m 777 /home/imp /data /tmp/warm && cd /tmp/warm \
    && imp demo -o demo --quiet \
    && imp run demo/arena.mcap -o graph --set tracker.kind=scan_to_map --set estimator.kind=graph --quiet \
    && python -c "from impslam.platform.virtual.process import VirtualRobot as V; v = V('arena'); v.start(); v.close()" \
    && rm -r /tmp/warm && chmod -R a+rwX /home/imp
USER 1000
WORKDIR /data
ENTRYPOINT ["imp"]
CMD ["--help"]
