-- ================================================================================================
-- rosbayes: bm_register_block
-- Registers of a board: stores written values and selects read data.
-- Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one.
-- MIT licence; datasheet: docs/hardware/bm_register_block.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm_register_map.all;

entity bm_register_block is
  port (
    clk_i             : in    std_logic;                      -- clock
    rst_i             : in    std_logic;                      -- reset of the board
    write_i           : in    std_logic;                      -- write data_i to the word; the access must be allowed
    read_i            : in    std_logic;                      -- read the word
    word_i            : in    std_logic_vector(7 downto 0);   -- index of the word: address / 4
    data_i            : in    std_logic_vector(31 downto 0);  -- data to write
    data_o            : out   std_logic_vector(31 downto 0);  -- data read; valid one clock after read_i
    liveness_i        : in    std_logic_vector(31 downto 0);  -- value for reads of LIVENESS
    liveness_o        : out   std_logic_vector(31 downto 0);  -- value written to LIVENESS
    programmed_i      : in    std_logic_vector(31 downto 0);  -- value for reads of PROGRAMMED
    map_hash_i        : in    std_logic_vector(255 downto 0); -- value for reads of MAP_HASH
    image_hash_i      : in    std_logic_vector(255 downto 0); -- value for reads of IMAGE_HASH
    cap_machine_i     : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_MACHINE
    cap_lines_i       : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_LINES
    cap_total_lines_i : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_TOTAL_LINES
    cap_line_offset_i : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_LINE_OFFSET
    cap_partition_i   : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_PARTITION
    cap_sensors_i     : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_SENSORS
    cap_widths_i      : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_WIDTHS
    cap_banks_i       : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_BANKS
    cap_replicas_i    : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_REPLICAS
    cap_interface_i   : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_INTERFACE
    cap_speed_i       : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_SPEED
    cap_steps_i       : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_STEPS
    cap_link_i        : in    std_logic_vector(31 downto 0);  -- value for reads of CAP_LINK
    cap_sensor_bits_i : in    std_logic_vector(511 downto 0); -- value for reads of CAP_SENSOR_BITS
    control_o         : out   std_logic_vector(31 downto 0);  -- value written to CONTROL
    target_count_o    : out   std_logic_vector(31 downto 0);  -- value written to TARGET_COUNT
    max_cycles_o      : out   std_logic_vector(63 downto 0);  -- value written to MAX_CYCLES
    bank_o            : out   std_logic_vector(31 downto 0);  -- value written to BANK
    prior_select_o    : out   std_logic_vector(31 downto 0);  -- value written to PRIOR_SELECT
    run_until_o       : out   std_logic_vector(63 downto 0);  -- value written to RUN_UNTIL
    start_o           : out   std_logic_vector(31 downto 0);  -- value written to START
    resume_o          : out   std_logic_vector(31 downto 0);  -- value written to RESUME
    done_i            : in    std_logic_vector(31 downto 0);  -- value for reads of DONE
    status_i          : in    std_logic_vector(31 downto 0);  -- value for reads of STATUS
    cycles_i          : in    std_logic_vector(63 downto 0);  -- value for reads of CYCLES
    compute_ns_i      : in    std_logic_vector(63 downto 0);  -- value for reads of COMPUTE_NS
    halt_o            : out   std_logic_vector(255 downto 0)  -- value written to HALT
  );
end entity bm_register_block;

architecture rtl of bm_register_block is

  signal liveness        : std_logic_vector(31 downto 0)  := (others => '0');
  signal control         : std_logic_vector(31 downto 0)  := (others => '0');
  signal target_count    : std_logic_vector(31 downto 0)  := (others => '0');
  signal max_cycles      : std_logic_vector(63 downto 0)  := (others => '0');
  signal bank            : std_logic_vector(31 downto 0)  := (others => '0');
  signal prior_select    : std_logic_vector(31 downto 0)  := (others => '0');
  signal run_until       : std_logic_vector(63 downto 0)  := (others => '0');
  signal start           : std_logic_vector(31 downto 0)  := (others => '0');
  signal resume          : std_logic_vector(31 downto 0)  := (others => '0');
  signal cycles_high     : std_logic_vector(31 downto 0)  := (others => '0');
  signal cycles_held     : std_logic                      := '0';
  signal compute_ns_high : std_logic_vector(31 downto 0)  := (others => '0');
  signal compute_ns_held : std_logic                      := '0';
  signal halt            : std_logic_vector(255 downto 0) := (others => '0');

begin

  store : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (write_i = '1' and unsigned(word_i) = LIVENESS_ADDRESS / 4) then
        liveness(31 downto 0) <= data_i(31 downto 0);
      end if;
      control(0) <= '0';
      if (write_i = '1' and unsigned(word_i) = CONTROL_ADDRESS / 4) then
        control(1 downto 0) <= data_i(1 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = TARGET_COUNT_ADDRESS / 4) then
        target_count(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = MAX_CYCLES_ADDRESS / 4) then
        max_cycles(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = MAX_CYCLES_ADDRESS / 4 + 1) then
        max_cycles(63 downto 32) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = BANK_ADDRESS / 4) then
        bank(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = PRIOR_SELECT_ADDRESS / 4) then
        prior_select(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = RUN_UNTIL_ADDRESS / 4) then
        run_until(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = RUN_UNTIL_ADDRESS / 4 + 1) then
        run_until(63 downto 32) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = START_ADDRESS / 4) then
        start(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = RESUME_ADDRESS / 4) then
        resume(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4) then
        halt(31 downto 0) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4 + 1) then
        halt(63 downto 32) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4 + 2) then
        halt(95 downto 64) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4 + 3) then
        halt(127 downto 96) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4 + 4) then
        halt(159 downto 128) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4 + 5) then
        halt(191 downto 160) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4 + 6) then
        halt(223 downto 192) <= data_i(31 downto 0);
      end if;
      if (write_i = '1' and unsigned(word_i) = HALT_ADDRESS / 4 + 7) then
        halt(255 downto 224) <= data_i(31 downto 0);
      end if;
      if (rst_i = '1') then
        liveness     <= (others => '0');
        control      <= (others => '0');
        target_count <= (others => '0');
        max_cycles   <= (others => '0');
        bank         <= (others => '0');
        prior_select <= (others => '0');
        run_until    <= (others => '0');
        start        <= (others => '0');
        resume       <= (others => '0');
        halt         <= (others => '0');
      end if;
    end if;

  end process store;

  liveness_o     <= liveness;
  control_o      <= control;
  target_count_o <= target_count;
  max_cycles_o   <= max_cycles;
  bank_o         <= bank;
  prior_select_o <= prior_select;
  run_until_o    <= run_until;
  start_o        <= start;
  resume_o       <= resume;
  halt_o         <= halt;

  -- Reading a low word holds the high word until the high word is read, so that both are of the same value.
  hold_high_words : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (read_i = '1' and unsigned(word_i) = CYCLES_ADDRESS / 4) then
        cycles_high <= cycles_i(63 downto 32);
        cycles_held <= '1';
      end if;
      if (rst_i = '1' or (read_i = '1' and unsigned(word_i) = CYCLES_ADDRESS / 4 + 1)) then
        cycles_held <= '0';
      end if;
      if (read_i = '1' and unsigned(word_i) = COMPUTE_NS_ADDRESS / 4) then
        compute_ns_high <= compute_ns_i(63 downto 32);
        compute_ns_held <= '1';
      end if;
      if (rst_i = '1' or (read_i = '1' and unsigned(word_i) = COMPUTE_NS_ADDRESS / 4 + 1)) then
        compute_ns_held <= '0';
      end if;
    end if;

  end process hold_high_words;

  select_word : process (clk_i) is

    variable found : std_logic_vector(31 downto 0);

  begin

    if rising_edge(clk_i) then
      if (read_i = '1') then
        -- one at most is not 0
        found := (others => '0');
        if (unsigned(word_i) = ID_ADDRESS / 4) then
          found := found or x"31304D42";
        end if;
        if (unsigned(word_i) = MAP_VERSION_ADDRESS / 4) then
          found := found or x"00010003";
        end if;
        if (unsigned(word_i) = LIVENESS_ADDRESS / 4) then
          found := found or liveness_i(31 downto 0);
        end if;
        if (unsigned(word_i) = PROGRAMMED_ADDRESS / 4) then
          found := found or programmed_i(31 downto 0);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4) then
          found := found or map_hash_i(31 downto 0);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4 + 1) then
          found := found or map_hash_i(63 downto 32);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4 + 2) then
          found := found or map_hash_i(95 downto 64);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4 + 3) then
          found := found or map_hash_i(127 downto 96);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4 + 4) then
          found := found or map_hash_i(159 downto 128);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4 + 5) then
          found := found or map_hash_i(191 downto 160);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4 + 6) then
          found := found or map_hash_i(223 downto 192);
        end if;
        if (unsigned(word_i) = MAP_HASH_ADDRESS / 4 + 7) then
          found := found or map_hash_i(255 downto 224);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4) then
          found := found or image_hash_i(31 downto 0);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4 + 1) then
          found := found or image_hash_i(63 downto 32);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4 + 2) then
          found := found or image_hash_i(95 downto 64);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4 + 3) then
          found := found or image_hash_i(127 downto 96);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4 + 4) then
          found := found or image_hash_i(159 downto 128);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4 + 5) then
          found := found or image_hash_i(191 downto 160);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4 + 6) then
          found := found or image_hash_i(223 downto 192);
        end if;
        if (unsigned(word_i) = IMAGE_HASH_ADDRESS / 4 + 7) then
          found := found or image_hash_i(255 downto 224);
        end if;
        if (unsigned(word_i) = CAP_MACHINE_ADDRESS / 4) then
          found := found or cap_machine_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_LINES_ADDRESS / 4) then
          found := found or cap_lines_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_TOTAL_LINES_ADDRESS / 4) then
          found := found or cap_total_lines_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_LINE_OFFSET_ADDRESS / 4) then
          found := found or cap_line_offset_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_PARTITION_ADDRESS / 4) then
          found := found or cap_partition_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_SENSORS_ADDRESS / 4) then
          found := found or cap_sensors_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_WIDTHS_ADDRESS / 4) then
          found := found or cap_widths_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_BANKS_ADDRESS / 4) then
          found := found or cap_banks_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_REPLICAS_ADDRESS / 4) then
          found := found or cap_replicas_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_INTERFACE_ADDRESS / 4) then
          found := found or cap_interface_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_SPEED_ADDRESS / 4) then
          found := found or cap_speed_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_STEPS_ADDRESS / 4) then
          found := found or cap_steps_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_LINK_ADDRESS / 4) then
          found := found or cap_link_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4) then
          found := found or cap_sensor_bits_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 1) then
          found := found or cap_sensor_bits_i(63 downto 32);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 2) then
          found := found or cap_sensor_bits_i(95 downto 64);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 3) then
          found := found or cap_sensor_bits_i(127 downto 96);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 4) then
          found := found or cap_sensor_bits_i(159 downto 128);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 5) then
          found := found or cap_sensor_bits_i(191 downto 160);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 6) then
          found := found or cap_sensor_bits_i(223 downto 192);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 7) then
          found := found or cap_sensor_bits_i(255 downto 224);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 8) then
          found := found or cap_sensor_bits_i(287 downto 256);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 9) then
          found := found or cap_sensor_bits_i(319 downto 288);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 10) then
          found := found or cap_sensor_bits_i(351 downto 320);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 11) then
          found := found or cap_sensor_bits_i(383 downto 352);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 12) then
          found := found or cap_sensor_bits_i(415 downto 384);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 13) then
          found := found or cap_sensor_bits_i(447 downto 416);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 14) then
          found := found or cap_sensor_bits_i(479 downto 448);
        end if;
        if (unsigned(word_i) = CAP_SENSOR_BITS_ADDRESS / 4 + 15) then
          found := found or cap_sensor_bits_i(511 downto 480);
        end if;
        if (unsigned(word_i) = CONTROL_ADDRESS / 4) then
          found := found or (control(31 downto 0) and x"00000002");
        end if;
        if (unsigned(word_i) = TARGET_COUNT_ADDRESS / 4) then
          found := found or target_count(31 downto 0);
        end if;
        if (unsigned(word_i) = MAX_CYCLES_ADDRESS / 4) then
          found := found or max_cycles(31 downto 0);
        end if;
        if (unsigned(word_i) = MAX_CYCLES_ADDRESS / 4 + 1) then
          found := found or max_cycles(63 downto 32);
        end if;
        if (unsigned(word_i) = BANK_ADDRESS / 4) then
          found := found or bank(31 downto 0);
        end if;
        if (unsigned(word_i) = PRIOR_SELECT_ADDRESS / 4) then
          found := found or prior_select(31 downto 0);
        end if;
        if (unsigned(word_i) = RUN_UNTIL_ADDRESS / 4) then
          found := found or run_until(31 downto 0);
        end if;
        if (unsigned(word_i) = RUN_UNTIL_ADDRESS / 4 + 1) then
          found := found or run_until(63 downto 32);
        end if;
        if (unsigned(word_i) = START_ADDRESS / 4) then
          found := found or start(31 downto 0);
        end if;
        if (unsigned(word_i) = RESUME_ADDRESS / 4) then
          found := found or resume(31 downto 0);
        end if;
        if (unsigned(word_i) = DONE_ADDRESS / 4) then
          found := found or done_i(31 downto 0);
        end if;
        if (unsigned(word_i) = STATUS_ADDRESS / 4) then
          found := found or status_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CYCLES_ADDRESS / 4) then
          found := found or cycles_i(31 downto 0);
        end if;
        if (unsigned(word_i) = CYCLES_ADDRESS / 4 + 1) then
          if (cycles_held = '1') then
            found := found or cycles_high;
          else
            found := found or cycles_i(63 downto 32);
          end if;
        end if;
        if (unsigned(word_i) = COMPUTE_NS_ADDRESS / 4) then
          found := found or compute_ns_i(31 downto 0);
        end if;
        if (unsigned(word_i) = COMPUTE_NS_ADDRESS / 4 + 1) then
          if (compute_ns_held = '1') then
            found := found or compute_ns_high;
          else
            found := found or compute_ns_i(63 downto 32);
          end if;
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4) then
          found := found or halt(31 downto 0);
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4 + 1) then
          found := found or halt(63 downto 32);
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4 + 2) then
          found := found or halt(95 downto 64);
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4 + 3) then
          found := found or halt(127 downto 96);
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4 + 4) then
          found := found or halt(159 downto 128);
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4 + 5) then
          found := found or halt(191 downto 160);
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4 + 6) then
          found := found or halt(223 downto 192);
        end if;
        if (unsigned(word_i) = HALT_ADDRESS / 4 + 7) then
          found := found or halt(255 downto 224);
        end if;
        data_o <= found;
      end if;
    end if;

  end process select_word;

end architecture rtl;
