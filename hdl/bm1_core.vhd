-- ================================================================================================
-- rosbayes: bm1_core
-- The Bayesian machine without its registers: generators, control, and a matrix for each replica.
-- MIT licence; datasheet: docs/hardware/bm1_core.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;

entity bm1_core is
  generic (
    LINES         : positive;         -- number of lines on this board
    SENSORS       : natural;          -- number of sensor columns
    REPLICAS      : positive;         -- number of replicas: machines that share the generators
    MODE          : sensor_mode_t;    -- input of the cells in a sensor column
    ADDRESS_BITS  : natural_array_t;  -- address widths of the sensor columns (index 1 to SENSORS)
    PROB_BITS     : positive;         -- width of a probability code
    PRIOR_BITS    : natural;          -- width of the prior's address
    WRITTEN       : boolean;          -- true: the host writes the prior; false: the prior is a table
    COUNTER_BITS  : positive;         -- width of a counter
    KIND          : rng_kind_t;       -- generators: LFSR or table
    STATE_BITS    : positive;         -- width of a generator's state
    TAPS          : std_logic_vector; -- feedback taps of an LFSR; STATE_BITS wide
    RNG_SHARED    : boolean;          -- true: one generator per column; false: one per cell
    STEPS         : positive;         -- steps of a generator per clock
    BANKS         : positive;         -- number of seed sets
    RESET_BANK    : boolean;          -- true: each frame restarts the generators; false: they continue
    TABLE_LENGTH  : positive;         -- number of random numbers in the generators' table
    MEMORY_FOLDER : string;           -- folder of the MIFs, with a trailing slash
    BOARD         : natural           -- index of this board
  );
  port (
    -- system
    clk_i : in    std_logic; -- clock
    rst_i : in    std_logic; -- reset of the board
    -- commands, one clock long
    start_i  : in    std_logic; -- start a frame
    resume_i : in    std_logic; -- run the frame's next slice
    reset_i  : in    std_logic; -- stop the machine and clear counters and cycles
    -- settings
    target_i     : in    std_logic_vector(COUNTER_BITS - 1 downto 0);    -- target count
    max_cycles_i : in    std_logic_vector(63 downto 0);                  -- maximum cycles of a frame
    run_until_i  : in    std_logic_vector(63 downto 0);                  -- end of the slice
    bank_i       : in    std_logic_vector(bits_for(BANKS) - 1 downto 0); -- number of the seed set
    halt_i       : in    std_logic_vector(REPLICAS - 1 downto 0);        -- replicas to halt
    -- inputs of the frame, replica 0 lowest
    priors_i      : in    std_logic_vector(REPLICAS * SLOT_BITS - 1 downto 0);         -- each replica's address in the prior's table
    prior_codes_i : in    std_logic_vector(REPLICAS * LINES * SLOT_BITS - 1 downto 0); -- written prior
    inputs_i      : in    std_logic_vector(
      REPLICAS * SENSORS * inputs_per_column(MODE, LINES) * SLOT_BITS - 1 downto 0);   -- readings
    -- outcome
    running_o         : out   std_logic;                                                     -- the machine runs
    done_o            : out   std_logic;                                                     -- the machine stops in this clock
    has_run_o         : out   std_logic;                                                     -- the machine has run since the last reset
    cycles_o          : out   std_logic_vector(63 downto 0);                                 -- cycles of the frame
    reason_o          : out   std_logic_vector(2 downto 0);                                  -- stop reason
    ready_o           : out   std_logic_vector(REPLICAS - 1 downto 0);                       -- bit r: replica r can be resumed
    replica_reasons_o : out   std_logic_vector(3 * REPLICAS - 1 downto 0);                   -- stop reason of each replica
    replica_cycles_o  : out   std_logic_vector(64 * REPLICAS - 1 downto 0);                  -- cycles of each replica
    counts_o          : out   std_logic_vector(REPLICAS * LINES * COUNTER_BITS - 1 downto 0) -- counters
  );
end entity bm1_core;

architecture rtl of bm1_core is

  constant COLUMNS    : positive := SENSORS + 1;
  constant GENERATORS : positive := COLUMNS * (LINES + to_natural(RNG_SHARED) * (1 - LINES));
  constant PER_INPUT  : natural  := SENSORS * inputs_per_column(MODE, LINES) * SLOT_BITS;

  -- Return the common start of the paths of a board's MIFs.

  function board_prefix return string is
  begin

    return MEMORY_FOLDER & "board" & integer'image(BOARD) & "_";

  end function board_prefix;

  -- Return the path of the seeds' MIF: all boards share it, unless every cell has a generator.

  function seed_file return string is
  begin

    if (RNG_SHARED) then
      return MEMORY_FOLDER & "rng_seeds.mif";
    end if;

    return board_prefix & "rng_seeds.mif";

  end function seed_file;

  signal load         : std_logic;
  signal clear        : std_logic;
  signal enable       : std_logic_vector(REPLICAS - 1 downto 0);
  signal target       : std_logic_vector(COUNTER_BITS - 1 downto 0);
  signal overflow     : std_logic_vector(REPLICAS - 1 downto 0);
  signal impossible   : std_logic_vector(REPLICAS - 1 downto 0);
  signal seeds_ready  : std_logic;
  signal restart      : std_logic;
  signal restart_bank : std_logic;
  signal step         : std_logic;
  signal bank         : std_logic_vector(bits_for(BANKS) - 1 downto 0);
  signal randoms      : std_logic_vector(GENERATORS * PROB_BITS - 1 downto 0);
  signal states       : std_logic_vector(GENERATORS * STATE_BITS - 1 downto 0);

begin

  bank <= bank_i when restart_bank = '1' else
          (others => '0');

  generators_of_board : entity work.bm1_generators
    generic map (
      generators   => GENERATORS,
      kind         => KIND,
      state_bits   => STATE_BITS,
      taps         => TAPS,
      steps        => STEPS,
      banks        => BANKS,
      prob_bits    => PROB_BITS,
      seed_file    => seed_file,
      table_file   => MEMORY_FOLDER & "rng_table.mif",
      table_length => TABLE_LENGTH
    )
    port map (
      clk_i     => clk_i,
      rst_i     => rst_i,
      restart_i => restart,
      bank_i    => bank,
      step_i    => step,
      ready_o   => seeds_ready,
      randoms_o => randoms,
      states_o  => states
    );

  control : entity work.bm1_control
    generic map (
      replicas     => REPLICAS,
      counter_bits => COUNTER_BITS,
      reset_bank   => RESET_BANK
    )
    port map (
      clk_i             => clk_i,
      rst_i             => rst_i,
      start_i           => start_i,
      resume_i          => resume_i,
      reset_i           => reset_i,
      target_i          => target_i,
      max_cycles_i      => max_cycles_i,
      run_until_i       => run_until_i,
      halt_i            => halt_i,
      overflow_i        => overflow,
      impossible_i      => impossible,
      load_o            => load,
      clear_o           => clear,
      enable_o          => enable,
      target_o          => target,
      seeds_ready_i     => seeds_ready,
      restart_o         => restart,
      restart_bank_o    => restart_bank,
      step_o            => step,
      running_o         => running_o,
      done_o            => done_o,
      has_run_o         => has_run_o,
      cycles_o          => cycles_o,
      reason_o          => reason_o,
      ready_o           => ready_o,
      replica_reasons_o => replica_reasons_o,
      replica_cycles_o  => replica_cycles_o
    );

  each_replica : for r in 0 to REPLICAS - 1 generate

    matrix : entity work.bm1_matrix
      generic map (
        lines         => LINES,
        sensors       => SENSORS,
        mode          => MODE,
        address_bits  => ADDRESS_BITS,
        prob_bits     => PROB_BITS,
        prior_bits    => PRIOR_BITS,
        written       => WRITTEN,
        counter_bits  => COUNTER_BITS,
        rng_shared    => RNG_SHARED,
        memory_prefix => board_prefix
      )
      port map (
        clk_i         => clk_i,
        load_i        => load,
        clear_i       => clear,
        enable_i      => enable(r),
        target_i      => target,
        overflow_o    => overflow(r),
        impossible_o  => impossible(r),
        prior_i       => priors_i((r + 1) * SLOT_BITS - 1 downto r * SLOT_BITS),
        prior_codes_i => prior_codes_i((r + 1) * LINES * SLOT_BITS - 1 downto r * LINES * SLOT_BITS),
        inputs_i      => inputs_i((r + 1) * PER_INPUT - 1 downto r * PER_INPUT),
        randoms_i     => randoms,
        counts_o      => counts_o((r + 1) * LINES * COUNTER_BITS - 1 downto r * LINES * COUNTER_BITS)
      );

  end generate each_replica;

end architecture rtl;
